"""Run terms and operator commands over gRPC: group policies, group ends, pauses, drains."""

import asyncio
import contextlib
import functools

import pytest
from tests.fakes import waiting
from tests.fakes.guarded import packed
from tests.fakes.worker import FakeWorker

from embomatrix.manager.services.app import running
from embomatrix.manager.settings import ManagerSettings
from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupDone,
    GroupPolicy,
    InfraFailure,
    LookaheadEntry,
    PlanCell,
    Rollout,
    RolloutResult,
    RunTerms,
    Warmth,
)

pytestmark = pytest.mark.timeout(60)
KITCHEN, DATA = packed("a kitchen")


@contextlib.asynccontextmanager
async def manager(tmp_path, **changes):
    options = {"port": 0, "http_port": 0, "data_dir": tmp_path, "state": "memory:", "heartbeat_s": 0.2}
    async with running(ManagerSettings(**{**options, "stream_grace_s": 0.2, **changes})) as endpoints:
        yield endpoints.address


@contextlib.asynccontextmanager
async def open_run(address, policy=GroupPolicy.RETRY_THEN_FAIL_GROUP, run_id="r1"):
    async with ClusterClient(address) as client:
        await client.open_run("test", run_id, RunTerms(policy))
        await client.put_bundles({KITCHEN: DATA})
        yield client


def batch_of(*tasks, size=2, run_id="r1"):
    """Return rollouts in groups of this size; a rollout of the task "poison" kills its slot."""
    rollouts = tuple(Rollout(f"x{i}", f"g{i // size}", KITCHEN, task, (), i) for i, task in enumerate(tasks))
    return Batch(run_id, "b1", 1, rollouts)


async def events(client, batch):
    found = [event async for event in client.events(batch, deadline_s=20)]
    results = {e.rollout_id: e.outcome for e in found if isinstance(e, RolloutResult)}
    return results, [event for event in found if isinstance(event, GroupDone)]


until = functools.partial(waiting.until, limit_s=5.0)


async def test_lost_rollout_cancels_its_own_group_only(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address) as client,
        FakeWorker(address, poison={"poison"}, execute_s=0.01),
    ):
        results, groups = await events(client, batch_of("poison", "t", "t", "t", "t", size=3))
        assert isinstance(results["x0"], InfraFailure)
        assert isinstance(results["x2"], Completed | Cancelled)
        assert isinstance(results["x3"], Completed)
        assert {group.group_id for group in groups} == {"g0", "g1"}
        assert len(groups) == 2
        assert (await client.close_run("r1")).groups_failed == 1


async def test_partial_groups_keep_the_other_results(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address, GroupPolicy.PARTIAL) as client,
        FakeWorker(address, poison={"poison"}),
    ):
        results, groups = await events(client, batch_of("poison", "t", "t"))
        assert isinstance(results["x0"], InfraFailure)
        assert isinstance(results["x1"], Completed)
        assert set(groups) == {GroupDone("g0", completed=1, infra_failures=1), GroupDone("g1", completed=1)}


async def test_fail_fast_batch_ends_with_its_first_failure(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address, GroupPolicy.FAIL_FAST) as client,
        FakeWorker(address, poison={"poison"}, stuck={"stuck"}, slots=2) as worker,
    ):
        results, _ = await events(client, batch_of("stuck", "poison", "t", "t", size=1))
        assert isinstance(results["x1"], InfraFailure)
        assert "attempt 1 of 1" in results["x1"].message
        assert isinstance(results["x0"], Cancelled)
        assert worker.executed.count("x1") == 1


async def test_group_end_is_reported_once_from_any_cursor(tmp_path):
    async with manager(tmp_path) as address, open_run(address) as client, FakeWorker(address, slots=2):
        await events(client, batch_of(*"tttt"))
        for cursor in range(5):
            reported = []
            request = pb.WaitExecutionRequest(run_id="r1", batch_id="b1", after_cursor=cursor)
            results = 0
            async for answer in client._rollouts.WaitExecution(request, timeout=5):
                results += len(answer.results)
                reported += [group.group_id for group in answer.groups]
            assert results == 4 - cursor
            assert len(reported) == len(set(reported))
            if cursor == 0:
                assert sorted(reported) == ["g0", "g1"]
            if cursor == 4:
                assert reported == []


async def test_run_terms_survive_a_manager_restart(tmp_path):
    state = {"state": f"sqlite:{tmp_path / 'state.sqlite'}"}
    async with manager(tmp_path, **state) as address, open_run(address, GroupPolicy.PARTIAL):
        pass
    async with (
        manager(tmp_path, **state) as address,
        ClusterClient(address) as client,
        FakeWorker(address, poison={"poison"}),
    ):
        results, _ = await events(client, batch_of("poison", "t"))
        assert isinstance(results["x1"], Completed)


async def test_paused_dispatch_gives_no_leases(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address) as client,
        FakeWorker(address) as worker,
        AdminClient(address) as admin,
    ):
        await admin.pause_dispatch()
        waiting = asyncio.create_task(events(client, batch_of("t", "t")))
        await until(lambda: worker.residents)
        await asyncio.sleep(0.5)
        assert worker.executed == []
        await admin.resume_dispatch()
        results, _ = await waiting
        assert all(isinstance(outcome, Completed) for outcome in results.values())


async def test_paused_worker_keeps_its_scenes_and_gets_nothing_new(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address) as client,
        FakeWorker(address) as worker,
        AdminClient(address) as admin,
    ):
        await events(client, batch_of("t"))
        worker.pause("the owner is back")
        await until(lambda: worker.residents)
        await asyncio.sleep(0.1)
        (found,) = await admin.list_workers()
        assert found.state == "paused"
        assert found.reason == "the owner is back"
        batch = Batch("r1", "b2", 2, (Rollout("y0", "g", KITCHEN, "t", (), 0),))
        waiting = asyncio.create_task(events(client, batch))
        await asyncio.sleep(0.5)
        assert KITCHEN in worker.residents
        assert "y0" not in worker.executed
        worker.pause("")
        assert isinstance((await waiting)[0]["y0"], Completed)


async def test_drain_can_be_cancelled(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address) as client,
        FakeWorker(address) as worker,
        AdminClient(address) as admin,
    ):
        await admin.drain_worker("w1")
        assert (await admin.list_workers())[0].state == "draining"
        await admin.resume("w1")
        assert (await admin.list_workers())[0].state == "ready"
        await until(lambda: worker.resumed)
        results, _ = await events(client, batch_of("t"))
        assert isinstance(results["x0"], Completed)
        with pytest.raises(NotFoundError, match="there is no worker 'w2'"):
            await admin.resume("w2")


async def test_plan_shows_coming_scenes_and_their_workers(tmp_path):
    async with (
        manager(tmp_path) as address,
        open_run(address) as client,
        FakeWorker(address, load_s=0.2) as worker,
        AdminClient(address) as admin,
    ):
        entries = [LookaheadEntry(7, KITCHEN, 4), LookaheadEntry(8, KITCHEN, 4)]
        (answer,) = await client.announce_window("r1", 1, entries)
        assert answer.warmth in (Warmth.WARMING, Warmth.QUEUED)
        await until(lambda: worker.fetched)
        await asyncio.sleep(0.3)
        cells = await admin.plan("r1")
        assert cells == tuple(PlanCell("r1", step, KITCHEN, 4, Warmth.WARM, ("w1",)) for step in (7, 8))
        assert await admin.plan() == cells
        with pytest.raises(NotFoundError, match="run 'other' is not open"):
            await admin.plan("other")


async def test_straggler_is_hedged_and_its_group_completes(tmp_path):
    async with (
        manager(tmp_path, hedge_after_s=0.3) as address,
        open_run(address) as client,
        FakeWorker(address, worker_id="quick", slots=2, execute_s=0.01),
        FakeWorker(address, worker_id="stuck", slots=2, execute_s=0.01, stuck={"late"}) as stuck,
    ):
        await events(client, batch_of(*["t"] * 40, size=20))
        await until(lambda: KITCHEN in stuck.residents)
        await asyncio.sleep(0.1)
        before = len(stuck.executed)
        batch = Batch("r1", "b2", 2, tuple(Rollout(f"y{i}", "g", KITCHEN, "late", (), i) for i in range(24)))
        results, (group,) = await events(client, batch)
        assert group == GroupDone("g", completed=24)
        assert {outcome.worker_id for outcome in results.values()} == {"quick"}
        stats = await client.close_run("r1")
        assert 1 <= stats.hedged <= 3
        assert len(stuck.executed) > before
