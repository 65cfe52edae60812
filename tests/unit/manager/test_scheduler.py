"""Resource-Scheduler: placement of scenes, and hits and waste of loading ahead."""

from dataclasses import replace

import hypothesis.strategies as st
import pytest
from hypothesis import given
from tests.fakes.worker import completed

from embomatrix.manager.control.commands import SetDesired
from embomatrix.manager.control.events import (
    BatchSubmitted,
    DemandObserved,
    DrainChanged,
    LeaseFinished,
    LookaheadAnnounced,
    RunClosed,
    SuspicionChanged,
    Tick,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
)
from embomatrix.manager.control.schedule.placement import MOST_SCENES, Need, Site, needs_of, place
from embomatrix.manager.control.schedule.readiness import BELIEVED_S, KNOWN_SCENES, SceneCosts
from embomatrix.manager.control.schedule.residency import KEPT_SCENES
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits, Scheduler
from embomatrix.manager.control.workers import WorkerPool
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import (
    Batch,
    LookaheadEntry,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    Timings,
    Warmth,
)

MB = 100.0


class Cluster:
    """Scheduler with workers that load every assigned scene."""

    def __init__(self):
        self.pool = WorkerPool()
        self.scheduler = Scheduler(
            ScheduleLimits(scene_mb=MB, affinity_wait_s=0.5, retry_load_s=10), self.pool.workers
        )
        self.now_s = 0.0
        self.desired = {}

    def apply(self, event, after_s=0.0):
        self.now_s += after_s
        self.change_standing(event)
        urgency = self.scheduler.note(event, now_s=self.now_s)
        commands = self.scheduler.place(now_s=self.now_s) if urgency else []
        for command in commands:
            assert isinstance(command, SetDesired)
            self.desired[command.worker_id] = command.bundle_digests
        return commands

    def change_standing(self, event):
        """Apply a change of the worker's state, as the dispatcher would."""
        match event:
            case WorkerJoined(worker_id, resources):
                self.pool.join(worker_id, resources)
            case WorkerLost(worker_id):
                self.pool.leave(worker_id)
            case WorkerReported() | DrainChanged() | SuspicionChanged():
                worker = self.pool.workers[event.worker_id]
                worker.apply(event)
                self.pool.update_standing(worker)

    def worker(self, name="w1", slots=1, memory_mb=1000, score=1.0):
        self.apply(WorkerJoined(name, Resources(slots, slots, memory_mb, score)))
        return self.report(name, resync=True)

    def report(self, name="w1", state=ResidentState.WARM, scenes=None, resync=False, memory_mb=MB):
        scenes = self.desired.get(name, ()) if scenes is None else scenes
        residents = tuple(Resident(scene, state, 1.0, memory_mb, "no mesh") for scene in scenes)
        return self.apply(WorkerReported(name, residents, resync=resync))

    def announce(self, *steps, version=1, run_id="r1", count=4):
        entries = [LookaheadEntry(i + 1, scene, count) for i, scenes in enumerate(steps) for scene in scenes]
        return self.apply(LookaheadAnnounced(run_id, version, tuple(entries)))

    def demand(self, after_s=0.0, **pending):
        return self.apply(DemandObserved(pending), after_s)

    def submit(self, scene, step=1, after_s=0.0):
        self.apply(
            BatchSubmitted(Batch("r1", f"b{step}", step, (Rollout("x", "g", scene, "t", (), 0),))), after_s
        )


@pytest.fixture
def cluster():
    return Cluster()


def test_announced_scenes_are_loaded_nearest_step_first(cluster):
    cluster.worker()
    cluster.announce(["a"], ["b"], ["c"])
    assert cluster.desired["w1"] == ("a", "b", "c")


def test_scene_with_the_furthest_use_is_left_out_when_memory_is_full(cluster):
    cluster.worker(memory_mb=250)
    cluster.announce(["a"], ["b"], ["c"])
    assert cluster.desired["w1"] == ("a", "b")
    assert [cluster.scheduler.readiness.warmth(scene) for scene in "abc"] == [
        Warmth.WARMING,
        Warmth.WARMING,
        Warmth.QUEUED,
    ]


def test_scene_needed_last_is_evicted(cluster):
    cluster.worker(memory_mb=250)
    cluster.announce(["a"], ["b"])
    cluster.report()
    cluster.announce(["c"], ["a"], ["b"], version=2)
    assert cluster.desired["w1"] == ("c", "a")


def test_scenes_of_waiting_rollouts_come_before_announced_ones(cluster):
    cluster.worker(memory_mb=250)
    cluster.announce(["a"], ["b"])
    cluster.demand(z=3)
    assert cluster.desired["w1"] == ("z", "a")


def test_desired_set_is_sent_only_when_it_changes(cluster):
    cluster.worker()
    assert len(cluster.announce(["a", "b"])) == 1
    assert cluster.announce(["a", "b"], version=2) == []
    cluster.report(state=ResidentState.LOADING)
    assert cluster.report() == []
    assert cluster.apply(Tick()) == []


def test_window_of_a_lower_version_is_ignored(cluster):
    cluster.worker()
    cluster.announce(["a"], version=5)
    cluster.announce(["b"], version=4)
    cluster.announce(["b"], version=5)
    assert cluster.desired["w1"] == ("a",)


def test_scenes_spread_over_workers_by_slots(cluster):
    cluster.worker("w1", slots=3)
    cluster.worker("w2", slots=1)
    cluster.announce(["a", "b", "c", "d"], count=1)
    assert len(cluster.desired["w1"]) == 3
    assert len(cluster.desired["w2"]) == 1


def test_faster_worker_gets_more_scenes(cluster):
    cluster.worker("w1", score=1.0)
    cluster.worker("w2", score=3.0)
    cluster.announce(["a", "b", "c", "d"], count=1)
    assert len(cluster.desired["w2"]) == 3


def test_scene_of_a_large_group_is_placed_on_several_workers(cluster):
    for name in ("w1", "w2", "w3"):
        cluster.worker(name, slots=2)
    cluster.demand(big=16)
    assert all("big" in cluster.desired[name] for name in ("w1", "w2", "w3"))


def test_scene_of_a_small_group_is_placed_on_one_worker(cluster):
    for name in ("w1", "w2"):
        cluster.worker(name, slots=4)
    cluster.demand(small=2)
    assert sum("small" in scenes for scenes in cluster.desired.values()) == 1


def test_idle_workers_load_a_scene_after_its_rollouts_waited_too_long(cluster):
    cluster.worker("w1", slots=1)
    cluster.worker("w2", slots=1)
    cluster.demand(a=1, b=1)
    for name in ("w1", "w2"):
        cluster.report(name)
    (first,) = [name for name, scenes in cluster.desired.items() if "a" in scenes]
    other = {"w1": "w2", "w2": "w1"}[first]
    cluster.apply(DemandObserved({"a": 1}, {"a": 0.4}, idle=frozenset([other])))
    assert "a" not in cluster.desired[other]
    cluster.apply(DemandObserved({"a": 1}, {"a": 1.1}, idle=frozenset([other])))
    assert "a" in cluster.desired[other]


def test_number_of_copies_is_stable_while_a_batch_runs_down(cluster):
    for name in ("w1", "w2"):
        cluster.worker(name, slots=1, memory_mb=150)
    cluster.announce(["next"])
    cluster.demand(big=16)
    for name in ("w1", "w2"):
        cluster.report(name)
    changes = [cluster.demand(big=left) for left in range(15, 0, -1)]
    assert changes == [[]] * 15


def test_outdated_report_changes_nothing(cluster):
    cluster.worker("w1", memory_mb=250)
    cluster.worker("w2", memory_mb=250)
    cluster.announce(["a", "b"], ["c", "d"])
    sent = dict(cluster.desired)
    assert cluster.report("w1", scenes=[]) == []
    assert cluster.report("w2", state=ResidentState.LOADING, scenes=sent["w2"][:1]) == []
    assert cluster.desired == sent


def test_scenes_with_running_rollouts_are_not_evicted(cluster):
    cluster.worker(memory_mb=150)
    cluster.demand(a=2)
    cluster.report()
    cluster.apply(DemandObserved({"b": 4}, in_use=frozenset([("w1", "a")])))
    assert cluster.desired["w1"] == ("a",)
    cluster.apply(DemandObserved({"b": 4}))
    assert cluster.desired["w1"] == ("b",)


def test_unneeded_scenes_stay_while_there_is_room_and_leave_by_last_use(cluster):
    cluster.worker(memory_mb=250)
    cluster.demand(a=1, b=1)
    cluster.report()
    cluster.apply(DemandObserved({}, used=frozenset([("w1", "a")])))
    assert set(cluster.desired["w1"]) == {"a", "b"}
    cluster.demand(c=1)
    assert cluster.desired["w1"] == ("c", "a")


def test_measured_memory_replaces_the_estimate(cluster):
    cluster.worker(memory_mb=1000)
    cluster.announce(["a", "b", "c"])
    cluster.report(memory_mb=400.0)
    cluster.apply(Tick())
    assert len(cluster.desired["w1"]) == 2


def test_scene_larger_than_every_worker_is_unplaceable_with_the_reason(cluster):
    cluster.worker(memory_mb=300)
    cluster.announce(["a"])
    cluster.report(memory_mb=900.0)
    cluster.apply(Tick())
    assert cluster.scheduler.readiness.warmth("a") is Warmth.WARM
    cluster.report(scenes=[])
    assert cluster.scheduler.readiness.warmth("a") is Warmth.UNPLACEABLE
    assert "900 MB" in cluster.scheduler.unplaceable["a"]


def test_memory_that_one_worker_claims_keeps_no_other_from_the_scene(cluster):
    cluster.worker("liar", memory_mb=10**9)
    cluster.worker("w1", memory_mb=1000)
    cluster.demand(a=1)
    cluster.report("liar", scenes=["a"], memory_mb=1e9)
    cluster.apply(Tick())
    assert cluster.scheduler.readiness.warmth("a") is Warmth.WARM
    cluster.pool.leave("liar")
    cluster.apply(WorkerLost("liar", "revoked"))
    assert cluster.desired["w1"] == ("a",)
    assert cluster.scheduler.unplaceable == {}


def test_worker_is_filled_by_its_own_measurements(cluster):
    cluster.worker("liar", memory_mb=1)
    cluster.worker("w1", memory_mb=1000)
    cluster.announce(["a", "b", "c"])
    cluster.report("liar", scenes=["a", "b", "c"], memory_mb=0.1)
    cluster.report("w1", scenes=["a", "b", "c"], memory_mb=400.0)
    cluster.apply(Tick())
    assert len(cluster.desired["w1"]) == 2


def test_load_time_that_one_worker_claims_counts_until_another_has_measured_it():
    costs = SceneCosts(MB)
    costs.learn("liar", Resident("a", ResidentState.WARM, 86_400.0, 1e9))
    assert (costs.load_s("a"), costs.size_mb("a")) == (BELIEVED_S, 1e9)
    costs.learn("w1", Resident("a", ResidentState.WARM, 2.0, 300.0))
    assert (costs.load_s("a"), costs.size_mb("a")) == (2.0, 300.0)
    for number in range(20):
        costs.learn(f"other-{number}", Resident("a", ResidentState.WARM, 3.0, 200.0))
    assert (costs.load_s("a"), costs.size_mb("a")) == (3.0, 200.0)
    costs.forget("w1")
    for number in range(20):
        costs.forget(f"other-{number}")
    assert (costs.load_s("a"), costs.size_mb("a")) == (0.0, MB)


@pytest.mark.parametrize("state", list(ResidentState))
def test_worker_that_reports_ever_new_scenes_grows_nothing_without_limit(cluster, state):
    cluster.worker("liar", memory_mb=10**9)
    for first in range(0, 20_000, 2_000):
        cluster.report("liar", state, [f"s{number}" for number in range(first, first + 2_000)], memory_mb=1.0)
    assert len(cluster.desired.get("liar", ())) <= MOST_SCENES
    residency = cluster.scheduler._residencies.by_id["liar"]
    for kept in (residency.failed_s, residency.failure_messages, residency.measured_mb):
        assert len(kept) <= KEPT_SCENES
    assert len(cluster.scheduler._costs._scenes) <= KNOWN_SCENES


def test_failed_load_moves_to_another_worker_and_is_retried_later(cluster):
    cluster.worker("w1")
    cluster.worker("w2")
    cluster.demand(a=1)
    (first,) = [name for name, scenes in cluster.desired.items() if scenes]
    other = {"w1": "w2", "w2": "w1"}[first]
    cluster.report(first, state=ResidentState.FAILED, scenes=["a"])
    assert cluster.desired[first] == ()
    assert cluster.desired[other] == ("a",)
    cluster.report(other, state=ResidentState.FAILED, scenes=["a"])
    assert cluster.desired[other] == ()
    cluster.apply(Tick(), after_s=11)
    assert "a" in cluster.desired[first] + cluster.desired[other]


@pytest.mark.parametrize(
    "event",
    [DrainChanged("w1", drained=True), SuspicionChanged("w1", suspect=True), WorkerLost("w1", "killed")],
)
def test_scenes_move_away_from_an_unusable_worker(cluster, event):
    cluster.worker("w1")
    cluster.announce(["a"])
    cluster.worker("w2")
    cluster.apply(event)
    assert cluster.desired["w2"] == ("a",)


def test_reconnected_worker_gets_its_desired_set_again(cluster):
    cluster.worker()
    cluster.announce(["a"])
    assert cluster.report(resync=True) == [SetDesired("w1", ("a",))]


def test_scene_that_is_warm_in_time_is_a_hit_with_its_lead(cluster):
    cluster.worker()
    cluster.announce(["a"])
    cluster.report()
    cluster.submit("a", after_s=3.0)
    cluster.submit("b", step=2)
    counters = cluster.scheduler.prewarm.counters("r1")
    assert (counters.hits, counters.misses) == (1, 1)
    assert cluster.scheduler.prewarm.leads.sum_s == 3.0
    assert cluster.scheduler.prewarm.counters("r1").leads.count == 1


def test_unused_load_ahead_is_waste(cluster):
    cluster.worker(memory_mb=150)
    cluster.announce(["a"])
    cluster.report()
    cluster.announce(["b"], version=2)
    cluster.report()
    assert cluster.scheduler.prewarm.counters("r1").wasted == 1


def test_used_load_ahead_is_no_waste(cluster):
    cluster.worker()
    cluster.announce(["a", "b"])
    cluster.report()
    cluster.apply(DemandObserved({}, used=frozenset([("w1", "a")])))
    cluster.apply(RunClosed("r1"))
    cluster.scheduler.prewarm.close("r1")
    assert cluster.scheduler.prewarm.counters("r1").wasted == 1


def test_submitted_steps_leave_the_window(cluster):
    cluster.worker()
    cluster.announce(["a"], ["b"], ["c"])
    cluster.submit("b", step=2)
    assert [entry.bundle_digest for entry in cluster.scheduler.windows["r1"].entries] == ["c"]


def test_scene_counts_at_its_next_use():
    entries = [LookaheadEntry(7, "a", 4), LookaheadEntry(5, "a", 2), LookaheadEntry(5, "b", 1)]
    assert needs_of({"c": 3}, [entries]) == [Need("c", 0, 3), Need("a", 1, 2), Need("b", 1, 1)]


class Listed:
    """List of sites without an index."""

    def __init__(self, sites):
        self._sites = {site.worker_id: site for site in sites}
        self.ids = sorted(self._sites, key=lambda name: (-self._sites[name].capacity, name))
        self.slots = sum(site.slots for site in sites)

    def site(self, worker_id):
        return self._sites[worker_id]

    def having(self, scene):
        return [name for name, site in self._sites.items() if scene in site.residents]

    def changed(self):
        return self.ids


scene_names = st.sampled_from("abcdefgh")


@given(
    needs=st.lists(
        st.builds(Need, scene_names, st.integers(0, 3), st.integers(1, 40)),
        unique_by=lambda n: n.bundle_digest,
    ),
    memories=st.lists(st.integers(0, 600), min_size=1, max_size=4),
    residents=st.lists(st.lists(scene_names, unique=True, max_size=5), min_size=4, max_size=4),
)
def test_placement_respects_memory_and_prefers_the_sooner_use(needs, memories, residents):
    sites = [Site(f"w{i}", 2, 1.0, mb, tuple(residents[i])) for i, mb in enumerate(memories)]
    desired = place(Listed(sites), needs, lambda _: MB).desired
    for site in sites:
        assert len(desired[site.worker_id]) <= max(1, site.memory_mb // MB)
        assert set(desired[site.worker_id]) <= {n.bundle_digest for n in needs} | set(site.residents)
    placed = {scene for scenes in desired.values() for scene in scenes}
    left = [need.rank for need in needs if need.bundle_digest not in placed]
    if left and not any(site.residents for site in sites):
        extra = sum(len(scenes) for scenes in desired.values()) - len(placed)
        assert max((n.rank for n in needs if n.bundle_digest in placed), default=0) <= min(left) or extra == 0
    again = [Site(s.worker_id, 2, 1.0, s.memory_mb, desired[s.worker_id]) for s in sites]
    after = place(Listed(again), needs, lambda _: MB).desired
    lost = {scene for scenes in desired.values() for scene in scenes} - {s for d in after.values() for s in d}
    assert not lost & {need.bundle_digest for need in needs if need.rank == 0}


def test_other_groups_of_a_started_step_stay_in_the_window(cluster):
    cluster.worker()
    cluster.announce(["a", "b"], ["c"])
    cluster.submit("a", step=1)
    assert [entry.bundle_digest for entry in cluster.scheduler.windows["r1"].entries] == ["b", "c"]


def test_scene_is_not_copied_if_loading_takes_longer_than_it_saves(cluster):
    for name in ("w1", "w2", "w3"):
        cluster.worker(name, slots=1)
    cluster.demand(known=1)
    for name in ("w1", "w2", "w3"):
        cluster.report(name)
    done = replace(completed(), timings=Timings(execute_s=0.01))
    cluster.apply(LeaseFinished("w1", LeaseRef("lease", 1), done))
    cluster.demand(quick=16)
    assert sum("quick" in scenes for scenes in cluster.desired.values()) == 1
    cluster.apply(LeaseFinished("w1", LeaseRef("lease", 2), replace(done, timings=Timings(execute_s=100.0))))
    cluster.demand(long=16)
    assert sum("long" in scenes for scenes in cluster.desired.values()) == 3


def test_scenes_of_redispatched_rollouts_are_loaded_before_later_ones(cluster):
    cluster.worker()
    cluster.apply(DemandObserved({"later": 30, "earlier": 2}, {"earlier": 5.0, "later": 1.0}))
    assert cluster.desired["w1"] == ("earlier", "later")
