"""A manager behind a real gRPC server on loopback, with fake workers that speak the protocol."""

import asyncio
import contextlib
import functools
import hashlib
import socket
import time
import zlib

import grpc
import httpx
import pytest
from tests.fakes import waiting
from tests.fakes.worker import FakeWorker, completed

from embomatrix.manager.services.app import running
from embomatrix.manager.settings import ManagerSettings
from embomatrix.manager.store.protocol import Candidate, FencedError
from embomatrix.manager.store.sqlite import SqliteStore
from embomatrix.proto.v1 import scene_service_pb2, scene_service_pb2_grpc
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import (
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    NotSignedInError,
    PreconditionError,
    SupersededError,
    cluster_error,
)
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Rollout,
    RunTerms,
    Warmth,
)

pytestmark = pytest.mark.timeout(60)


def bundle_of(text):
    data = zlib.compress(text.encode(), level=0)
    return f"sha256:{hashlib.sha256(data).hexdigest()}", data


KITCHEN, KITCHEN_DATA = bundle_of("a kitchen")
BEDROOM, BEDROOM_DATA = bundle_of("a bedroom")
BUNDLES = {KITCHEN: KITCHEN_DATA, BEDROOM: BEDROOM_DATA}


@contextlib.asynccontextmanager
async def manager(tmp_path, **changes):
    options = {"port": 0, "http_port": 0, "data_dir": tmp_path, "state": "memory:", "heartbeat_s": 0.2}
    async with running(ManagerSettings(**{**options, "stream_grace_s": 0.2, **changes})) as endpoints:
        yield endpoints


@contextlib.asynccontextmanager
async def open_run(address, run_id="r1", token=""):
    async with ClusterClient(address, token) as client:
        await client.open_run("test", run_id, RunTerms(GroupPolicy.PARTIAL))
        await client.put_bundles(BUNDLES)
        yield client


def batch(count, *, batch_id="b1", scene=KITCHEN, task="t", step=1, run_id="r1"):
    rollouts = tuple(Rollout(f"{batch_id}-{i}", f"g{i // 4}", scene, task, (), i) for i in range(count))
    return Batch(run_id, batch_id, step, rollouts)


async def outcomes(client, submitted):
    return {result.rollout_id: result async for result in client.execute(submitted, deadline_s=20)}


until = functools.partial(waiting.until, limit_s=5.0)


async def test_every_rollout_of_a_batch_comes_back_with_its_reward(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2) as worker,
    ):
        results = await outcomes(client, batch(100))
        assert len(results) == 100
        assert all(result.outcome.reward.goal == 15.0 for result in results.values())
        assert sorted(result.cursor for result in results.values()) == list(range(1, 101))
        assert worker.fetched == [(KITCHEN, KITCHEN_DATA)]
        stats = await client.close_run("r1")
        assert (stats.delivered, stats.infra_failures, stats.cold_starts) == (100, 0, 100)


async def test_large_result_message_does_not_delay_leases(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=4, stuck={"t"}) as worker,
    ):
        execution = asyncio.create_task(outcomes(client, batch(1000)))
        await until(lambda: len(worker.leases) == 8)
        worker.finish_all()  # so fast a worker is given many leases ahead
        await until(lambda: len(worker.leases) >= 200)
        worker.portions.clear()
        finished = worker.finish_all()
        await until(lambda: sum(worker.portions) >= finished)
        # Slots freed by the first results are leased again before the last results are processed.
        assert worker.portions[0] < finished / 2
        while not execution.done():
            worker.finish_all()
            await asyncio.sleep(0.01)
        assert len(execution.result()) == 1000


async def test_announced_scene_is_warm_before_its_batch_arrives(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, FakeWorker(at.address) as worker:
        first = await client.announce_lookahead("r1", 1, [LookaheadEntry(1, KITCHEN, 8)])
        assert first[KITCHEN] in (Warmth.WARMING, Warmth.QUEUED)
        await until(lambda: KITCHEN in worker.residents and worker.fetched)
        await asyncio.sleep(0.05)
        assert await client.announce_lookahead("r1", 2, [LookaheadEntry(1, KITCHEN, 8)]) == {
            KITCHEN: Warmth.WARM
        }
        results = await outcomes(client, batch(8))
        assert all(result.outcome.warm for result in results.values())
        stats = await client.close_run("r1")
        assert (stats.prewarm_hits, stats.prewarm_misses, stats.warm_starts) == (1, 0, 8)


async def test_killed_worker_loses_no_rollout(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client:
        victim = await FakeWorker(at.address, worker_id="victim", slots=4, stuck={"t"}).__aenter__()
        running_batch = asyncio.create_task(outcomes(client, batch(40)))
        await until(lambda: len(victim.executed) == 4)
        async with FakeWorker(at.address, worker_id="other", slots=4) as other:
            killed_s = time.monotonic()
            await victim.kill()
            results = await running_batch
            assert time.monotonic() - killed_s < 5.0
        assert len(results) == 40
        assert all(isinstance(result.outcome, Completed) for result in results.values())
        assert len(other.executed) == 40
        assert (await client.close_run("r1")).redispatched >= 4


async def test_history_of_a_rollout_names_its_leases_and_an_unknown_one_is_refused(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client:
        victim = await FakeWorker(at.address, worker_id="victim", stuck={"t"}).__aenter__()
        running_batch = asyncio.create_task(outcomes(client, batch(1)))
        await until(lambda: victim.executed)
        async with AdminClient(at.address) as admin:
            assert (await admin.explain("b1-0")).place.startswith("leased: ")
            async with FakeWorker(at.address, worker_id="other"):
                await victim.kill()
                await running_batch
            found = await admin.explain("b1-0")
            with pytest.raises(NotFoundError, match="no trace of rollout 'nothing'"):
                await admin.explain("nothing")
    leased = [step.worker_id for step in found.steps if step.kind == "leased"]
    assert (leased, found.steps[-1].kind, found.place) == (["victim", "other"], "delivered", "")
    assert abs(found.steps[0].at_s - time.time()) < 60


async def test_late_result_is_acknowledged_and_never_delivered(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client:
        async with FakeWorker(at.address, worker_id="slow", stuck={"t"}) as slow:
            running_batch = asyncio.create_task(outcomes(client, batch(1)))
            await until(lambda: slow.executed)
            (old,) = slow.leases.values()
        async with FakeWorker(at.address, worker_id="slow", execute_s=0.3) as again:
            await until(lambda: again.executed)
            again.report(old.ref, InfraFailure(InfraCode.SLOT_CRASHED, "late"))
            again.report(old.ref, completed("slow"))
            results = await running_batch
            await until(lambda: again.acknowledged.count(old.ref) == 2)
        assert [type(result.outcome) for result in results.values()] == [Completed]
        assert (await client.close_run("r1")).stale_results == 2


async def test_plan_that_crashes_its_slot_fails_alone(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client:
        async with FakeWorker(at.address, slots=2, poison={"poison"}):
            good, bad = batch(20), batch(1, batch_id="b2", task="poison")
            results = await outcomes(client, Batch("r1", "mixed", 1, good.rollouts + bad.rollouts))
        failure = results.pop("b2-0")
        assert failure.outcome.code is InfraCode.SLOT_CRASHED
        assert failure.attempt == 3
        assert all(isinstance(result.outcome, Completed) for result in results.values())


async def test_scene_that_two_workers_cannot_load_fails_its_rollouts(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, worker_id="w1", broken={BEDROOM}),
        FakeWorker(at.address, worker_id="w2", broken={BEDROOM}),
    ):
        results = await outcomes(client, batch(4, scene=BEDROOM))
        assert {result.outcome.code for result in results.values()} == {InfraCode.SCENE_LOAD_FAILED}
        assert "the mesh has no triangles" in results["b1-0"].outcome.message
        assert len(await outcomes(client, batch(4, batch_id="b2"))) == 4


async def test_rollouts_without_a_worker_fail_after_a_bounded_wait(tmp_path):
    async with manager(tmp_path, no_capacity_s=0.3) as at, open_run(at.address) as client:
        results = await outcomes(client, batch(2))
    assert {result.outcome.code for result in results.values()} == {InfraCode.NO_CAPACITY}
    assert "embomatrix worker" in results["b1-0"].outcome.message


async def test_trainer_reattaches_from_its_cursor(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, FakeWorker(at.address) as worker:
        first = [result async for result in client.execute(batch(30))]
        async with ClusterClient(at.address) as another:
            again = [result async for result in another.execute(batch(30))]
        assert [result.cursor for result in again] == [result.cursor for result in first]
        assert len(worker.executed) == 30


async def test_batch_id_with_other_content_is_refused(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, FakeWorker(at.address):
        await outcomes(client, batch(2))
        with pytest.raises(ConflictError, match="use a new id"):
            await outcomes(client, batch(3))


async def test_cancelled_batch_ends_at_once(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, stuck={"t"}) as worker,
    ):
        running_batch = asyncio.create_task(outcomes(client, batch(3)))
        await until(lambda: worker.executed)
        await client.cancel("r1", "b1")
        results = await running_batch
        assert all(isinstance(result.outcome, Cancelled) for result in results.values())
        await until(lambda: len(worker.cancelled) == 2)


async def test_restarted_manager_continues_its_batches(tmp_path):
    state = f"sqlite:{tmp_path / 'state.sqlite'}"
    async with (
        manager(tmp_path, state=state) as at,
        open_run(at.address) as client,
        FakeWorker(at.address) as worker,
    ):
        await outcomes(client, batch(5))
        unfinished = Batch("r1", "b2", 2, batch(4, batch_id="b2").rollouts)
        worker.stuck.add("t")
        with contextlib.suppress(Exception):
            await asyncio.wait_for(outcomes(client, unfinished), 0.3)
    async with (
        manager(tmp_path, state=state) as at,
        ClusterClient(at.address) as client,
        FakeWorker(at.address) as fresh,
    ):
        assert len(await outcomes(client, batch(5))) == 5
        assert fresh.executed == []
        assert len(await outcomes(client, unfinished)) == 4
        assert len(fresh.executed) == 4


async def test_restarted_manager_keeps_the_look_ahead_window(tmp_path):
    state = f"sqlite:{tmp_path / 'state.sqlite'}"
    async with manager(tmp_path, state=state) as at, open_run(at.address) as client, FakeWorker(at.address):
        window = [LookaheadEntry(1, KITCHEN, 4), LookaheadEntry(2, BEDROOM, 8)]
        await client.announce_lookahead("r1", 7, window)
        await outcomes(client, batch(4))
    async with manager(tmp_path, state=state) as at, FakeWorker(at.address) as worker:
        await until(lambda: list(worker.residents) == [BEDROOM])
        async with AdminClient(at.address) as admin:
            assert [(cell.step, cell.bundle_digest) for cell in await admin.plan("r1")] == [(2, BEDROOM)]
        async with ClusterClient(at.address) as client:
            await client.close_run("r1")
    async with manager(tmp_path, state=state) as at, open_run(at.address), AdminClient(at.address) as admin:
        assert await admin.plan("r1") == ()


async def test_deposed_manager_stops(tmp_path):
    state = f"sqlite:{tmp_path / 'state.sqlite'}"

    async def serve_until_fenced():
        async with (
            manager(tmp_path, state=state, leader_ttl_s=0.3) as at,
            open_run(at.address) as client,
            FakeWorker(at.address, stuck={"t"}) as worker,
        ):
            running_batch = asyncio.create_task(outcomes(client, batch(1)))
            await until(lambda: worker.executed)
            other = SqliteStore(tmp_path / "state.sqlite")
            # Another process on the same address may claim the leader lease at once.
            assert (await other.claim(Candidate(f"{socket.gethostname()}/{at.address}", "x:1", 60.0))).mine
            await other.close()
            (lease,) = worker.leases.values()
            worker.report(lease.ref, completed())
            try:
                await running_batch
            finally:
                running_batch.cancel()

    with pytest.raises(BaseExceptionGroup) as caught:
        await serve_until_fenced()
    assert caught.group_contains(FencedError, match="another manager took over")


async def test_uploaded_bundle_with_wrong_digest_is_refused(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        with pytest.raises(InvalidRequestError, match="damaged"):
            await client.put_bundles({KITCHEN: BEDROOM_DATA})
        with pytest.raises(InvalidRequestError, match="is not a digest"):
            await client.put_bundles({"../../etc/passwd": b"x"})
        assert await client.put_bundles({KITCHEN: KITCHEN_DATA}) == (KITCHEN,)
        assert await client.put_bundles({KITCHEN: KITCHEN_DATA}) == ()
    assert [path.suffix for path in (tmp_path / "bundles").iterdir()] == [".bundle"]


async def test_bundle_of_many_chunks_round_trips(tmp_path):
    digest, data = bundle_of("x" * 3_500_000)
    async with (
        manager(tmp_path) as at,
        ClusterClient(at.address) as client,
        open_channel(at.address) as channel,
    ):
        await client.put_bundles({digest: data})
        stub = scene_service_pb2_grpc.SceneServiceStub(channel)
        parts = [
            part.chunk
            async for part in stub.GetBundle(scene_service_pb2.GetBundleRequest(bundle_digest=digest))
        ]
    assert b"".join(parts) == data


async def test_rollouts_without_bundle_or_run_are_refused(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        with pytest.raises(NotFoundError, match="OpenRun"):
            await outcomes(client, batch(1))
        await client.open_run("test", "r1")
        with pytest.raises(PreconditionError, match=KITCHEN):
            await outcomes(client, batch(1))


async def test_stopped_manager_leaves_no_socket_in_the_event_loop(tmp_path):
    async with await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1") as server:
        async with manager(tmp_path) as at, httpx.AsyncClient(base_url=at.status_url) as http:
            assert (await http.get("/")).status_code == 200
        # New sockets get the numbers of closed ones: they can't connect by a number that the event loop still watches.
        address = server.sockets[0].getsockname()
        opened = [await asyncio.open_connection(*address) for _ in range(32)]
    assert len(opened) == 32


async def test_second_worker_with_the_same_id_ends_the_first_session(tmp_path):
    async with manager(tmp_path) as at, FakeWorker(at.address) as first:
        call = first._stub.Session(first._requests())
        await call.read()
        async with FakeWorker(at.address):
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await call.read()
        assert isinstance(cluster_error(caught.value, at.address), SupersededError)


async def test_drained_worker_gets_no_new_leases(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, worker_id="old") as old,
        FakeWorker(at.address, worker_id="new") as new,
    ):
        await client.drain_worker("old")
        assert len(await outcomes(client, batch(10))) == 10
        assert (len(old.executed), len(new.executed)) == (0, 10)
        states = {worker.worker_id: worker.state for worker in await client.list_workers()}
        assert states == {"old": "draining", "new": "ready"}


async def test_calls_without_the_token_are_refused(tmp_path):
    async with manager(tmp_path, token="secret") as at:
        async with ClusterClient(at.address) as stranger:
            with pytest.raises(NotSignedInError, match="EMBOMATRIX_TOKEN"):
                await stranger.list_workers()
        async with open_run(at.address, token="secret") as client, FakeWorker(at.address, token="secret"):
            assert len(await outcomes(client, batch(2))) == 2
        async with httpx.AsyncClient(base_url=at.status_url) as http:
            assert (await http.get("/healthz")).status_code == 200
            assert (await http.get("/api/v1/overview")).status_code == 401
            signed = {"authorization": "Bearer secret"}
            assert (await http.get("/api/v1/overview", headers=signed)).status_code == 200


async def test_status_page_shows_the_cluster(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, FakeWorker(at.address, slots=2):
        await outcomes(client, batch(10))
        await client.announce_lookahead(
            "r1", 1, [LookaheadEntry(5, KITCHEN, 8), LookaheadEntry(6, BEDROOM, 4)]
        )
        async with httpx.AsyncClient(base_url=at.status_url) as http:
            overview = (await http.get("/api/v1/overview")).json()
            assert overview["slots"] == 2
            assert overview["outcomes"] == {"completed": 10}
            (worker,) = (await http.get("/api/v1/workers")).json()["items"]
            assert worker["completed"] == 10
            (run,) = (await http.get("/api/v1/runs")).json()["items"]
            assert run["stats"]["delivered"] == 10
            steps = (await http.get("/api/v1/lookahead")).json()
            assert [step["step"] for step in steps] == [5, 6]
            assert steps[0]["cells"][0]["warmth"] == "warm"
            assert 'embo_rollouts_total{outcome="completed"} 10.0' in (await http.get("/metrics")).text
            assert "<html" in (await http.get("/")).text
            stranger = await http.get("/api/v1/overview", headers={"host": "evil.example"})
            assert stranger.status_code == 400
