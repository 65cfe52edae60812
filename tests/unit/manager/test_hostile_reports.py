"""Reports of workers and announcements of trainers take bounded memory and time, whatever they name."""

import time
import tracemalloc
from dataclasses import replace

import pytest
from tests.fakes.worker import completed

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.events import (
    BatchSubmitted,
    LeaseFinished,
    LookaheadAnnounced,
    RunOpened,
    Tick,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
)
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.store.opening import open_store
from embomatrix.rpc.status import OverloadedError
from embomatrix.rpc.wire.values import (
    Batch,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    RunTerms,
    Timings,
)

MACHINE = Resources(4, 4, 4096)


@pytest.fixture
def cluster():
    made = ClusterState(lease_key=b"key")
    made.handle(RunOpened("r1", RunTerms()), now_s=0.0)
    made.handle(WorkerJoined("w1", MACHINE), now_s=0.0)
    return made


def kept_mb(act):
    """Return the memory that is still in use after the act, in MB."""
    tracemalloc.start()
    try:
        act()
        return tracemalloc.get_traced_memory()[0] / 1e6
    finally:
        tracemalloc.stop()


def report(cluster, *residents, now_s=1.0):
    return cluster.handle(WorkerReported("w1", residents, (), resync=True), now_s=now_s)


@pytest.mark.parametrize("state", [ResidentState.FAILED, ResidentState.WARM])
def test_scenes_that_a_worker_names_once_are_forgotten(cluster, state):
    def name_many():
        for turn in range(200):
            scenes = [f"sha256:{turn:032d}{number:032d}" for number in range(400)]
            error = "e" * 500 if state is ResidentState.FAILED else ""
            residents = (Resident(scene, state, 1.0, 1.0, error + scene if error else "") for scene in scenes)
            report(cluster, *residents, now_s=1.0 + turn)
        report(cluster, now_s=300.0)

    assert kept_mb(name_many) < 8.0


def test_long_reasons_of_failures_are_cut_in_the_history(cluster):
    resident = Resident("kitchen", ResidentState.WARM)
    report(cluster, resident)
    words = "w" * 4_000

    def fail_often():
        for number in range(300):
            rollout = Rollout(f"x{number}", f"g{number}", "kitchen", "t", (), 0)
            given = cluster.handle(BatchSubmitted(Batch("r1", f"b{number}", 1, (rollout,))), now_s=1.0)
            for _ in range(3):
                (lease,) = (command for command in given if hasattr(command, "rollout"))
                failure = InfraFailure(InfraCode.SLOT_CRASHED, words + str(number))
                given = cluster.handle(LeaseFinished("w1", lease.ref, failure), now_s=1.0)

    assert kept_mb(fail_often) < 2.5


def test_names_of_workers_that_left_cost_nothing(cluster):
    def come_and_go():
        for number in range(3_000):
            cluster.handle(WorkerJoined(f"guest-{number}", MACHINE), now_s=1.0)
            cluster.handle(WorkerLost(f"guest-{number}", "it left"), now_s=1.0)

    assert kept_mb(come_and_go) < 0.3


def test_announced_scenes_that_no_worker_can_hold_are_refused_in_linear_time(cluster):
    """Eight thousand scenes need a GPU that no worker has. Comparing each with all others would take several seconds."""
    report(cluster)
    entries = tuple(LookaheadEntry(n % 100, f"sha256:{n:064d}", 1, render=True) for n in range(8_192))
    began_s = time.perf_counter()
    cluster.handle(LookaheadAnnounced("r1", 1, entries), now_s=10.0)
    assert time.perf_counter() - began_s < 2.0
    assert "no worker has any" in next(iter(cluster.scheduler.unplaceable.values()))


def test_most_urgent_of_many_scenes_are_placed_first(cluster):
    report(cluster)
    later = tuple(LookaheadEntry(7, f"later-{n}", 1) for n in range(3_000))
    soon = tuple(LookaheadEntry(2, f"soon-{n}", 1) for n in range(3))
    cluster.handle(LookaheadAnnounced("r1", 1, (*later, *soon)), now_s=10.0)
    assert set(cluster.scheduler.desired("w1")[:3]) == {"soon-0", "soon-1", "soon-2"}


def test_registry_refuses_more_workers_than_it_serves_and_forgets_the_first_lost_ones():
    registry = Registry(LivenessLimits(most_workers=3, most_lost=2))
    sessions = [registry.register(f"w{n}", "", MACHINE, now_s=0.0)[0] for n in range(3)]
    with pytest.raises(OverloadedError, match="3 workers are connected"):
        registry.register("w3", "", MACHINE, now_s=0.0)
    registry.register("w0", "again", MACHINE, now_s=0.0)
    for session in sessions[1:]:
        registry.end(session, "it left")
    registry.end(registry.sessions["w0"], "it left")
    registry.tick(now_s=0.1)
    assert set(registry.sessions) == {"w2", "w0"}


@pytest.fixture
async def runs(tmp_path):
    cluster, registry = ClusterState(lease_key=b"key"), Registry(LivenessLimits())
    bundles, archive = BundleStore(tmp_path / "bundles", total_bytes=1), RunArchive(tmp_path / "runs")
    runtime = ManagerRuntime(cluster, registry, open_store("memory:"), bundles, archive)
    await runtime.start()
    for number in range(5):
        await runtime.runs.open_run("run", f"r{number}")
    return runtime.runs


async def test_windows_of_all_runs_share_one_limit(runs):
    entries = tuple(LookaheadEntry(n, f"sha256:{n:064d}", 1) for n in range(4_096))
    for number in range(4):
        runs.announce(f"r{number}", 1, entries)
    runs.announce("r1", 2, entries)
    with pytest.raises(OverloadedError, match="other runs announced 16384"):
        runs.announce("r4", 1, entries[:1])


async def test_batch_of_more_scenes_than_may_wait_is_refused(runs):
    rollouts = tuple(Rollout(f"x{n}", "g", f"sha256:{n:064d}", "t", (), 0) for n in range(8_193))
    with pytest.raises(OverloadedError, match="has 8193 scenes"):
        await runs.submit(Batch("r0", "b1", 1, rollouts))


@pytest.mark.parametrize("told", [{"memory_mb": 1e9}, {"load_s": 86_400.0}])
def test_numbers_of_one_worker_keep_no_scene_from_the_others(cluster, told):
    liar = Resident("kitchen", ResidentState.WARM, **{"load_s": 1.0, "memory_mb": 64.0, **told})
    cluster.handle(WorkerJoined("w2", MACHINE), now_s=0.0)
    cluster.handle(WorkerReported("w2", (), (), resync=True), now_s=0.0)
    report(cluster, liar, now_s=1.0)
    _execute_one(cluster)
    rollouts = tuple(Rollout(f"x{number}", "g", "kitchen", "t", (), 0) for number in range(64))
    cluster.handle(BatchSubmitted(Batch("r1", "b2", 1, rollouts)), now_s=2.0)
    for at_s in range(3, 120):
        cluster.handle(Tick(), now_s=float(at_s))
    assert cluster.scheduler.desired("w2") == ("kitchen",)


def _execute_one(cluster):
    """Have ``w1`` execute one rollout, so that the time of an execution is known."""
    rollout = Rollout("x", "g", "kitchen", "t", (), 0)
    commands = cluster.handle(BatchSubmitted(Batch("r1", "b1", 1, (rollout,))), now_s=1.0)
    (lease,) = (command for command in commands if hasattr(command, "rollout"))
    outcome = replace(completed(), timings=Timings(execute_s=1.0))
    cluster.handle(LeaseFinished("w1", lease.ref, outcome), now_s=2.0)
