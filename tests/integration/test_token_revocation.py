"""Revoked, shared and passed-on tokens, also under later managers."""

import asyncio
import contextlib
import socket

import grpc
import pytest
from tests.fakes.guarded import (
    KITCHEN,
    KITCHEN_DATA,
    collect,
    guarded,
    joined,
    rollouts,
    trainer,
    until,
    worker,
)
from tests.fakes.redis_server import RedisServer

from embomatrix.cli.local_cluster import free_port
from embomatrix.manager.services.app import running
from embomatrix.manager.settings import ManagerSettings
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import (
    NotFoundError,
    NotSignedInError,
    PreconditionError,
    StandbyError,
)
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Batch, Completed

pytestmark = pytest.mark.timeout(120)


async def test_revoked_worker_stops_and_its_rollouts_are_redispatched(tmp_path):
    async with (
        guarded(tmp_path) as at,
        trainer(at) as client,
        await joined(at, "bad", slots=4, stuck={"t"}) as bad,
    ):
        batch = asyncio.create_task(collect(client, 8))
        await until(lambda: len(bad.executed) == 4)
        async with await joined(at, "good", slots=4) as good:
            async with at.operator() as operator:
                await operator.revoke_worker("bad", "its results were wrong")
            results = await batch
            assert len(good.executed) == 8
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await worker(at, "bad", token=bad.token).__aenter__()
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "its results were wrong" in caught.value.details()
    assert all(isinstance(result.outcome, Completed) for result in results)


async def test_revoking_an_unknown_worker_names_the_connected_ones(tmp_path):
    async with guarded(tmp_path) as at, await joined(at, "office") as spare, at.operator() as operator:
        with pytest.raises(NotFoundError, match=r"no worker 'offcie'.*connected: office\)"):
            await operator.revoke_worker("offcie", "its results were wrong")
        await spare.kill()
        # The credential of a worker that has left can still be revoked.
        await operator.revoke_worker("office", "sold")
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await worker(at, "office", token=spare.token).__aenter__()
        assert "sold" in caught.value.details()


async def test_revoking_a_token_ends_its_worker_sessions(tmp_path):
    async with guarded(tmp_path) as at:
        fleet = await at.issue(AccessRole.WORKER, label="the lab")
        async with worker(at, "pod-1", token=fleet) as pod:
            async with at.operator() as operator:
                known = {info.token_id: info for info in await operator.list_tokens()}
                assert known[fleet.partition(".")[0]].label == "the lab"
                await operator.revoke_token(fleet.partition(".")[0])
            await until(lambda: not pod._tasks)


async def test_trainer_whose_token_is_revoked_reads_no_further(tmp_path):
    async with guarded(tmp_path) as at, trainer(at) as client, await joined(at, "w1", execute_s=0.05):
        token = await at.issue(AccessRole.TRAINER)
        async with ClusterClient(at.address, token, ca=at.ca) as revoked:
            stream = revoked.execute(Batch("r1", "b1", 1, rollouts(40)), deadline_s=30)
            await anext(stream)
            async with at.operator() as operator:
                await operator.revoke_token(token.partition(".")[0])
            with pytest.raises(NotSignedInError, match="revoked"):
                async for _ in stream:
                    pass
        # The batch is complete: a trainer with a valid token attaches to it.
        assert len(await collect(client, 40)) == 40


async def test_tokens_and_revocations_survive_a_restart(tmp_path):
    async with guarded(tmp_path) as at:
        first = await joined(at, "w1")
        async with first:
            await asyncio.sleep(0.05)
        async with at.operator() as operator:
            await operator.revoke_token(at.token(AccessRole.VIEWER).partition(".")[0])
    async with guarded(tmp_path) as at:
        async with worker(at, "w1", token=first.token) as again:
            await asyncio.sleep(0.05)
            assert again.session
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await worker(at, "w2", join_token=first.join_token).__aenter__()
        assert "used already, by worker w1" in caught.value.details()
        async with ClusterClient(at.address, at.token(AccessRole.VIEWER), ca=at.ca) as client:
            with pytest.raises(NotSignedInError, match="revoked"):
                await client.list_workers()
    stored = b"".join(path.read_bytes() for path in tmp_path.glob("state.sqlite*"))
    assert first.token.partition(".")[2].encode() not in stored


async def test_standby_knows_the_tokens_after_take_over(tmp_path):
    """Two managers on one Redis: tokens issued and revoked by the first hold at the second, which stood by with TLS."""
    with RedisServer(tmp_path / "redis", free_port()) as redis:
        options = {"state": redis.url, "leader_ttl_s": 4.0}
        standby = free_port()
        over = asyncio.Event()

        async def take_over():
            async with guarded(tmp_path / "data", port=standby, **options) as at:
                for token, outcome in ((given, None), (taken, NotSignedInError)):
                    async with ClusterClient(at.address, token, ca=at.ca) as client:
                        with contextlib.nullcontext() if outcome is None else pytest.raises(outcome):
                            await client.open_run("test", "r1")
                async with worker(at, "w1", token=first.token) as again:
                    assert again.session
                    await asyncio.sleep(0.05)
                over.set()

        async with guarded(tmp_path / "data", **options) as at:
            given, taken = await at.issue(AccessRole.TRAINER), await at.issue(AccessRole.TRAINER)
            async with at.operator() as operator:
                await operator.revoke_token(taken.partition(".")[0])
            async with await joined(at, "w1") as first:
                await asyncio.sleep(0.05)
            waiting = asyncio.create_task(take_over())
            await until(lambda: stands_by(standby))
            async with ClusterClient(f"127.0.0.1:{standby}", given, ca=at.ca) as client:
                with pytest.raises(StandbyError):
                    await client.list_workers()
        await waiting
        assert over.is_set()


def stands_by(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


async def test_shared_token_has_the_admin_role(tmp_path):
    async with guarded(tmp_path, token="one-for-all") as at, worker(at, "w1", token="one-for-all") as w1:
        async with ClusterClient(at.address, "one-for-all", ca=at.ca) as client:
            await client.open_run("test", "r1")
            await client.put_bundles({KITCHEN: KITCHEN_DATA})
            assert len(await collect(client, 4)) == 4
            await client.drain_worker("w1")
        assert len(w1.executed) == 4
        async with ClusterClient(at.address, at.token(AccessRole.VIEWER), ca=at.ca) as client:
            assert [found.worker_id for found in await client.list_workers()] == ["w1"]


async def test_unguarded_manager_issues_no_tokens(tmp_path):
    settings = ManagerSettings(port=0, http_port=0, data_dir=tmp_path, state="memory:")
    async with running(settings) as at, AdminClient(at.address) as operator:
        with pytest.raises(PreconditionError, match="embomatrix manager init"):
            await operator.issue_token(AccessRole.TRAINER)
