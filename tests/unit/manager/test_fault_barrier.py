"""A manager survives messages that break its state machines: the sender is quarantined and disconnected."""

import asyncio
import contextlib

import pytest
from tests.fakes.waiting import until

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.events import (
    BatchContinued,
    LeasesRenewed,
    PauseChanged,
    Tick,
    WorkerReported,
)
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.intake import Heartbeat
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.store.opening import open_store
from embomatrix.rpc.status import InternalError, SupersededError
from embomatrix.rpc.wire.leases import WorkerState
from embomatrix.rpc.wire.values import Batch, Resident, ResidentState, Resources, Rollout


class FragileState(ClusterState):
    """State machines with a defect: they fail on events of one kind from one worker."""

    fails_on: type = type(None)

    def handle(self, *events, now_s):
        commands = super().handle(*events, now_s=now_s)
        if any(isinstance(e, self.fails_on) and getattr(e, "worker_id", "bad") == "bad" for e in events):
            raise KeyError("lease")
        return commands


@pytest.fixture
def away_s():
    """Seconds for which another manager may have led; more may be added."""
    return []


@pytest.fixture
async def runtime(tmp_path, away_s):
    cluster = FragileState(lease_key=b"key")
    bundles = BundleStore(tmp_path / "bundles", total_bytes=1)
    archive = RunArchive(tmp_path / "runs")
    runtime = ManagerRuntime(
        cluster,
        Registry(LivenessLimits()),
        open_store("memory:"),
        bundles,
        archive,
        lapsed_s=lambda: sum(away_s),
    )
    await runtime.start()
    for worker_id in ("good", "bad"):
        runtime.registry.register(worker_id, "", Resources(1, 1, 100), now_s=0.0)
        for event in runtime.registry.drain(worker_id) and runtime.registry.resume(worker_id):
            cluster.handle(event, now_s=0.0)
    return runtime


def beat(runtime, worker_id):
    session = runtime.registry.sessions[worker_id]
    return runtime.process_heartbeat(session.session_id, session.epoch, Heartbeat(()))


async def test_sender_of_a_heartbeat_that_breaks_the_state_is_quarantined(runtime):
    runtime.cluster.fails_on = LeasesRenewed
    with runtime.errors, pytest.raises(InternalError, match="worker bad is quarantined"):
        beat(runtime, "bad")
    assert runtime.cluster.dispatcher.auditor.of("bad").quarantine
    assert runtime.errors.total >= 1
    assert beat(runtime, "good") > 0
    with pytest.raises(SupersededError, match="register again"):
        beat(runtime, "bad")


async def test_sender_of_a_report_that_breaks_the_state_is_disconnected(runtime):
    runtime.cluster.fails_on = WorkerReported
    session = runtime.registry.sessions["bad"]
    with runtime.attached(session) as link:
        state = WorkerState((Resident("kitchen", ResidentState.WARM),))
        with pytest.raises(InternalError, match="broke the manager"):
            runtime.process_report(link, state, (), resync=True)
        with pytest.raises(InternalError, match="quarantined"):
            await link.take()
    assert session.standing.is_gone


async def test_events_after_a_failed_one_are_handled(runtime):
    runtime.cluster.fails_on = LeasesRenewed
    with pytest.raises(InternalError):
        beat(runtime, "bad")
    runtime.cluster.handle(Tick(), now_s=1e9)
    runtime.cluster.check_invariants()


@contextlib.asynccontextmanager
async def serving(runtime):
    """Serve until the end of the block, and demand that an error was logged and the manager still serves."""
    task = asyncio.create_task(runtime.serve())
    try:
        yield
        await until(lambda: runtime.errors.total or task.done(), limit_s=10.0)
        await asyncio.sleep(0.2)
        assert not task.done(), "the manager ended"
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_batch_that_breaks_the_state_after_its_first_portion_ends_no_manager(runtime, tmp_path):
    runtime.cluster.fails_on = BatchContinued
    (tmp_path / "bundles" / f"{'0' * 64}.bundle").touch()
    await runtime.runs.open_run("run", "r1")
    rollouts = tuple(Rollout(f"x{n}", "g", f"sha256:{'0' * 64}", "t", (), 0) for n in range(600))
    async with serving(runtime):
        await runtime.runs.submit(Batch("r1", "b1", 1, rollouts))


async def test_suspension_that_breaks_the_state_ends_no_manager(runtime, away_s):
    runtime.cluster.fails_on = PauseChanged
    async with serving(runtime):
        away_s.append(1.0)


async def test_run_that_its_trainer_closes_during_the_search_for_idle_runs_ends_no_manager(runtime):
    for name in ("r1", "r2"):
        await runtime.runs.open_run("run", name)
    closing = asyncio.create_task(runtime.runs.close_run("r2"))
    await runtime.runs.close_idle(1e9)
    await closing
    assert not runtime.runs.open
