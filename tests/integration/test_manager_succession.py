"""Operator and audit decisions survive a change of the manager."""

import asyncio
import contextlib

import pytest
from tests.fakes.redis_server import RedisServer
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BUNDLES, batch, manager, outcomes, until

from embomatrix.cli.local_cluster import free_port
from embomatrix.manager.store.opening import open_store
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import UnavailableError
from embomatrix.rpc.wire.values import Completed, GroupPolicy, Resources, RunTerms
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.session import register

pytestmark = pytest.mark.timeout(60)
VERIFIED = RunTerms(GroupPolicy.PARTIAL, verified=True)


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory):
    with RedisServer(tmp_path_factory.mktemp("redis"), free_port()) as server:
        yield server.url


@pytest.fixture(params=["sqlite", "redis"])
def state(request, tmp_path):
    if request.param == "sqlite":
        return f"sqlite:{tmp_path / 'state.sqlite'}"
    return request.getfixturevalue("redis_url")


@contextlib.asynccontextmanager
async def people(address):
    async with ClusterClient(address) as client, AdminClient(address) as admin:
        await client.put_bundles(BUNDLES)
        yield client, admin


async def states(admin):
    return {info.worker_id: info.state for info in await admin.list_workers()}


async def test_quarantine_survives_a_manager_change(tmp_path, state):
    async with manager(tmp_path, state=state) as at, people(at.address) as (client, admin):
        await client.open_run("verified", "r1", VERIFIED)
        async with (
            FakeWorker(at.address, "liar", lies=True),
            FakeWorker(at.address, "w2"),
            FakeWorker(at.address, "w3"),
        ):
            results = await outcomes(client, batch(8))
            assert {result.outcome.reward.goal for result in results.values()} == {15.0}
            assert (await states(admin))["liar"] == "quarantined"
        await client.close_run("r1")
    async with manager(tmp_path / "second", state=state) as at, people(at.address) as (client, admin):
        await client.open_run("plain", "r1")
        async with FakeWorker(at.address, "liar", lies=True) as liar:
            assert await states(admin) == {"liar": "quarantined"}
            reason = (await admin.list_workers())[0].reason
            assert "contradicts w2 and w3" in reason or "contradicts w3 and w2" in reason
            running = asyncio.create_task(outcomes(client, batch(2)))
            async with FakeWorker(at.address, "w2") as honest:
                assert all(isinstance(r.outcome, Completed) for r in (await running).values())
                assert (len(liar.executed), len(honest.executed)) == (0, 2)
            await admin.resume("liar")
            assert (await states(admin))["liar"] == "ready"
    third = manager(tmp_path / "third", state=state)
    async with third as at, people(at.address) as (_, admin), FakeWorker(at.address, "liar"):
        assert await states(admin) == {"liar": "ready"}


async def test_next_manager_waits_for_every_joined_worker(tmp_path, state):
    async with manager(tmp_path, state=state) as at:
        for name in ("w1", "w2", "w3"):
            await register(Membership(at.address, name), boot_id=name, resources=Resources(1, 1, 100))
            store = open_store(state)
            assert name in await store.workers()
            await store.close()


async def test_dispatch_pause_survives_a_manager_change(tmp_path, state):
    async with manager(tmp_path, state=state) as at, people(at.address) as (client, admin):
        await client.open_run("test", "r2")
        await admin.pause_dispatch()
    second = manager(tmp_path / "second", state=state)
    async with second as at, people(at.address) as (client, admin), FakeWorker(at.address) as worker:
        running = asyncio.create_task(outcomes(client, batch(2, run_id="r2")))
        await until(lambda: worker.residents)
        await asyncio.sleep(0.3)
        assert worker.executed == []
        await admin.resume_dispatch()
        assert len(await running) == 2
    third = manager(tmp_path / "third", state=state)
    async with third as at, people(at.address) as (client, _), FakeWorker(at.address):
        assert len(await outcomes(client, batch(2, batch_id="b2", run_id="r2"))) == 2


async def test_manager_warns_of_another_data_folder(tmp_path, state, caplog):
    warned = {}
    for turn, folder in enumerate(("one", "one", "other")):
        caplog.clear()
        async with manager(tmp_path / folder, state=state):
            pass
        warned[turn] = [line for line in caplog.messages if "differs from that of the last leader" in line]
    assert warned[1] == []
    [line] = warned[2]
    assert f"the data folder {tmp_path / 'other'} differs" in line
    assert "--data-dir" in line


async def test_pause_without_the_store_holds_and_reports_it(tmp_path):
    server = RedisServer(tmp_path, free_port())
    with server:
        async with manager(tmp_path, state=server.url) as at, people(at.address) as (client, admin):
            await client.open_run("test", "r1")
            server.kill()
            with pytest.raises(
                UnavailableError, match=r"dispatch is paused, but not stored for other managers"
            ):
                await admin.pause_dispatch()
