"""Task-Dispatcher: commands that follow from events."""

import pytest
from tests.fakes.dispatch import Table, crash, leases
from tests.fakes.worker import completed

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease, FinishBatch
from embomatrix.manager.control.dispatch.state import LOAD_FAILURES_KEPT, LoadFailures, steps_of
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchSubmitted,
    DrainChanged,
    LeaseFinished,
    LeasesRenewed,
    RunClosed,
    ScenesUnplaceable,
    SuspicionChanged,
    Tick,
    WorkerJoined,
    WorkerLost,
)
from embomatrix.rpc.wire.bounds import HELD_LEASES
from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    InfraCode,
    InfraFailure,
    Resources,
    Rollout,
)


@pytest.fixture
def table():
    return Table()


def test_rollout_goes_to_the_worker_with_its_scene_warm(table):
    table.worker("w1", warm=["bedroom"])
    table.worker("w2", warm=["kitchen"])
    (lease,) = leases(table.submit())
    assert lease.worker_id == "w2"
    assert table.finish(lease)[0] == AcknowledgeLease("w2", lease.ref)
    assert isinstance(table.results["b1-0"].outcome, Completed)


def test_rollout_waits_while_its_scene_is_warm_nowhere(table):
    table.worker(warm=[])
    assert leases(table.submit(3)) == []
    demand = table.dispatcher.demand()
    assert demand.pending == {"kitchen": 3}
    assert demand.idle == {"w1"}
    assert len(leases(table.report(warm=["kitchen"]))) == 2


def test_worker_gets_no_lease_before_its_first_report(table):
    table.apply(WorkerJoined("w1", Resources(4, 4, 1024)))
    assert leases(table.submit()) == []


def test_worker_holds_one_lease_per_slot_and_one_queued_behind_each(table):
    table.worker(slots=2)
    assert len(leases(table.submit(10))) == 4


def test_freed_slot_is_filled_by_the_same_event(table):
    table.worker()
    first, _ = leases(table.submit(3))
    (third,) = leases(table.finish(first))
    assert third.rollout.rollout_id == "b1-2"


def test_rollouts_spread_over_the_least_busy_workers(table):
    table.worker("w1", slots=1)
    table.worker("w2", slots=3)
    given = [lease.worker_id for lease in leases(table.submit(4))]
    assert sorted(given) == ["w1", "w2", "w2", "w2"]


def test_batch_finishes_after_its_last_result_with_cursors_from_one(table):
    table.worker(slots=4)
    given = leases(table.submit(3))
    commands = [command for lease in given for command in table.finish(lease)]
    assert commands[-1] == FinishBatch("r1", "b1")
    assert [result.cursor for result in table.results.values()] == [1, 2, 3]


def test_rollouts_of_a_lost_worker_are_redispatched_at_once(table):
    table.worker("w1", slots=2)
    table.submit(4)
    table.worker("w2", slots=2)
    given = leases(table.apply(WorkerLost("w1", "killed")))
    assert {lease.worker_id for lease in given} == {"w2"}
    assert len(given) == 4


def test_only_started_leases_of_a_lost_worker_cost_an_attempt(table):
    for name in ("w1", "w2", "w3"):
        table.worker(name)
        if name == "w1":
            table.submit(2)
        table.apply(WorkerLost(name, "killed"))
    assert table.results["b1-0"].outcome.code is InfraCode.WORKER_LOST
    assert table.results["b1-0"].attempt == 3
    assert "b1-1" not in table.results


def test_poison_rollout_fails_after_three_crashes_and_others_complete(table):
    table.worker()
    given = leases(table.submit(3))
    while given:
        lease = given.pop(0)
        given += leases(table.finish(lease, crash() if lease.rollout.rollout_id == "b1-0" else None))
    assert table.results["b1-0"].outcome.code is InfraCode.SLOT_CRASHED
    assert "attempt 3 of 3" in table.results["b1-0"].outcome.message
    assert table.results["b1-0"].outcome.worker_id == "w1"
    assert all(isinstance(table.results[name].outcome, Completed) for name in ("b1-1", "b1-2"))


def test_late_result_is_acknowledged_counted_and_dropped(table):
    table.worker("w1")
    (old,) = leases(table.submit())
    table.worker("w2")
    (new,) = leases(table.apply(WorkerLost("w1", "silent")))
    assert table.finish(old) == [AcknowledgeLease("w1", old.ref)]
    assert table.results == {}
    table.finish(new)
    table.finish(new)
    assert table.results["b1-0"].attempt == 2
    assert table.dispatcher.counters("r1").stale_results == 2


def test_result_under_another_epoch_or_worker_is_stale(table):
    table.worker()
    (lease,) = leases(table.submit())
    for worker_id, ref in (("w1", LeaseRef(lease.ref.lease_id, 99)), ("w2", lease.ref)):
        table.apply(LeaseFinished(worker_id, ref, completed()))
    assert table.results == {}
    table.finish(lease)
    assert len(table.results) == 1


def test_lease_without_renewal_expires(table):
    table.worker()
    (lease,) = leases(table.submit())
    table.apply(LeasesRenewed("w1", (lease.ref,)), after_s=29)
    assert table.apply(Tick(), after_s=2) == []
    commands = table.apply(Tick(), after_s=30)
    assert commands[0] == CancelLease("w1", lease.ref)
    assert leases(commands)[0].ref.lease_epoch > lease.ref.lease_epoch


def test_renewed_lease_expires_at_its_limit(table):
    table.worker()
    (lease,) = leases(table.submit())
    for steps in range(9):
        table.apply(LeasesRenewed("w1", (lease.ref,), (LeaseProgress(lease.ref, steps),)), Tick(), after_s=10)
    assert table.dispatcher.live_leases
    table.apply(LeasesRenewed("w1", (lease.ref,)), after_s=9)
    commands = table.apply(Tick(), after_s=2)
    assert CancelLease("w1", lease.ref) in commands


def test_leases_that_expire_behind_a_busy_slot_cost_no_attempt_and_are_leased_again():
    """Counterexample that the lease machine found.

    The expiry of the running lease "started" the lease behind it, and so on. All of them then counted as failures of their
    worker, whose slots stayed free although rollouts waited.
    """
    table = Table()
    table.worker("w1")
    (running, queued) = leases(table.submit(2))
    table.worker("w2", warm=())
    commands = table.apply(Tick(), after_s=31)
    assert [command.ref for command in commands if isinstance(command, CancelLease)] == [
        running.ref,
        queued.ref,
    ]
    (again,) = leases(commands)
    assert (again.worker_id, again.rollout.rollout_id, again.origin.attempt) == ("w1", "b1-1", 1)


def test_worker_skips_any_number_of_rollouts_that_failed_on_it():
    table = Table()
    table.worker("w1", slots=12)
    table.worker("w2", warm=())
    failed = [f"b1-{index}" for index in range(12)]
    for lease in leases(table.submit(40)):
        if lease.rollout.rollout_id in failed:
            table.finish(lease, crash())
    held = {lease.record.key.rollout_id for lease in table.dispatcher.live_leases.values()}
    assert held == {f"b1-{index}" for index in range(12, 36)}


def test_leases_missing_after_a_reconnect_are_redispatched(table):
    table.worker(slots=2)
    first, second = leases(table.submit(2))
    commands = table.report(warm=["kitchen"], held=[first.ref], resync=True)
    (again,) = leases(commands)
    assert again.rollout == second.rollout
    assert first.ref.lease_id in table.dispatcher.live_leases


def test_later_report_returns_no_lease(table):
    table.worker(slots=2)
    table.submit(2)
    assert table.report(warm=["kitchen"], held=[]) == []


def test_unknown_lease_of_a_former_manager_is_cancelled(table):
    table.apply(WorkerJoined("w1", Resources(1, 1, 1024)))
    ghost = LeaseRef("other-1", 1)
    assert table.report(held=[ghost], resync=True) == [CancelLease("w1", ghost)]


def test_suspected_worker_gets_no_lease_until_it_is_heard(table):
    table.worker()
    table.apply(SuspicionChanged("w1", suspect=True))
    assert leases(table.submit()) == []
    assert len(leases(table.apply(SuspicionChanged("w1", suspect=False)))) == 1


def test_drained_worker_finishes_its_leases_and_gets_no_new_ones(table):
    table.worker()
    first, second = leases(table.submit(5))
    table.apply(DrainChanged("w1", drained=True))
    assert leases(table.finish(first)) == leases(table.finish(second)) == []
    assert len(table.results) == 2


def test_idle_slot_steals_a_lease_queued_behind_a_busy_one(table):
    table.worker("w1", slots=1)
    running, waiting = leases(table.submit(2))
    table.worker("w2", slots=1)
    commands = table.apply(Tick(), after_s=1.0)
    assert commands[0] == CancelLease("w1", waiting.ref)
    (stolen,) = leases(commands)
    assert (stolen.worker_id, stolen.rollout) == ("w2", waiting.rollout)
    table.finish(stolen)
    table.finish(running)
    assert {result.attempt for result in table.results.values()} == {1}


def test_cancelled_batch_finishes_at_once_and_frees_its_slots(table):
    table.worker()
    given = leases(table.submit(3))
    table.submit(1, batch_id="b2")
    commands = table.apply(BatchCancelled("r1", "b1"))
    assert all(isinstance(table.results[f"b1-{i}"].outcome, Cancelled) for i in range(3))
    assert {c.ref for c in commands if isinstance(c, CancelLease)} == {lease.ref for lease in given}
    assert [lease.rollout.rollout_id for lease in leases(commands)] == ["b2-0"]


def test_closed_run_cancels_only_its_own_batches(table):
    table.submit(2)
    rollout = Rollout("other", "g", "kitchen", "t", (), 0)
    table.apply(BatchSubmitted(Batch("r2", "b1", 1, (rollout,))))
    table.apply(RunClosed("r1"))
    assert set(table.results) == {"b1-0", "b1-1"}
    assert table.dispatcher.pending_of("r2") == 1


def test_rollout_fails_at_its_deadline(table):
    table.worker(warm=[])
    table.submit()
    table.apply(Tick(), after_s=599)
    assert table.results == {}
    table.apply(Tick(), after_s=2)
    assert table.results["b1-0"].outcome.code is InfraCode.DEADLINE


def test_rollouts_without_a_worker_fail_after_the_bounded_wait(table):
    table.submit()
    table.apply(Tick(), after_s=59)
    assert table.results == {}
    table.apply(Tick(), after_s=2)
    assert table.results["b1-0"].outcome.code is InfraCode.NO_CAPACITY


def test_later_rollout_waits_for_the_whole_limit_too(table):
    table.apply(Tick(), after_s=100)
    table.submit()
    table.apply(Tick(), after_s=30)
    assert table.results == {}


def test_unplaceable_scene_fails_its_rollouts_with_the_reason(table):
    table.worker(warm=[])
    table.submit()
    table.apply(ScenesUnplaceable({"kitchen": "needs 900 MB"}))
    table.apply(Tick(), after_s=61)
    assert table.results["b1-0"].outcome == InfraFailure(InfraCode.NO_CAPACITY, "needs 900 MB")


def test_scene_that_fails_on_two_workers_fails_its_rollouts(table):
    table.worker("w1", warm=[])
    table.worker("w2", warm=[])
    table.submit(2)
    table.report("w1", failed=["kitchen"])
    assert table.results == {}
    table.report("w2", failed=["kitchen"])
    assert {result.outcome.code for result in table.results.values()} == {InfraCode.SCENE_LOAD_FAILED}
    assert "no mesh" in table.results["b1-0"].outcome.message


def test_single_load_failure_is_ignored_while_another_worker_has_the_scene(table):
    table.worker("w1", warm=[])
    table.worker("w2")
    table.report("w1", failed=["kitchen"])
    (lease,) = leases(table.submit())
    assert lease.worker_id == "w2"


def test_only_worker_may_fail_to_load_for_a_while(table):
    table.worker(warm=[])
    table.submit()
    table.report(failed=["kitchen"])
    table.apply(Tick(), after_s=9)
    assert table.results == {}
    table.apply(Tick(), after_s=2)
    assert table.results["b1-0"].outcome.code is InfraCode.SCENE_LOAD_FAILED


def test_worker_with_a_broken_scene_does_not_get_the_rollout_straight_back(table):
    table.worker("w1")
    table.worker("w2", warm=[])
    (lease,) = leases(table.submit())
    broken = InfraFailure(InfraCode.BUNDLE_CORRUPT, "digest mismatch")
    assert leases(table.finish(lease, broken)) == []
    assert leases(table.report("w2", warm=["kitchen"]))[0].worker_id == "w2"


def test_newer_session_loses_the_leases_of_the_older_one(table):
    table.worker("w1")
    (old,) = leases(table.submit())
    (new,) = leases(table.worker("w1"))
    assert new.ref.lease_epoch > old.ref.lease_epoch


def test_result_contains_the_queue_time(table):
    table.worker()
    first, second = leases(table.submit(2))
    table.apply(Tick(), after_s=2.0)
    table.submit(1, batch_id="b2")
    table.now_s += 3.0
    (third,) = leases(table.finish(first))
    table.finish(third)
    assert table.results["b2-0"].outcome.timings.queued_s == 3.0
    assert table.finish(second)


def test_warm_and_cold_starts_are_counted_separately(table):
    table.worker(warm=[])
    table.submit(1)
    (cold,) = leases(table.report(warm=["kitchen"]))
    table.finish(cold)
    (warm,) = leases(table.submit(1, batch_id="b2"))
    table.finish(warm)
    assert not table.results["b1-0"].outcome.warm
    assert table.results["b2-0"].outcome.warm
    counters = table.dispatcher.counters("r1")
    assert (counters.cold_starts, counters.warm_starts) == (1, 1)


def test_history_of_a_redispatched_rollout_names_workers_reasons_and_causes(table):
    table.worker("w1")
    table.submit(2)
    table.worker("w2")
    state = table.dispatcher.state
    assert state.where("b1-0").endswith(" on w1")
    (again, _) = leases(table.apply(WorkerLost("w1", "killed"), after_s=1.0))
    table.finish(again)
    steps = steps_of("b1-0", state.history(), state.batches_with("b1-0"))
    assert [(step.kind, step.worker_id, step.cause) for step in steps] == [
        ("submitted", "", "BatchSubmitted"),
        ("leased", "w1", "BatchSubmitted"),
        ("returned", "w1", "WorkerLost"),
        ("queued", "", "WorkerLost"),
        ("leased", "w2", "WorkerLost"),
        ("delivered", "", "LeaseFinished"),
    ]
    assert steps[2].reason == "worker lost: killed"
    assert (state.where("b1-0"), steps_of("b1-9", state.history(), set())) == ("", [])


def test_failure_names_the_worker_that_reported_it_whatever_it_says(table):
    table.worker("w1")
    table.worker("w2", warm=())
    commands = table.submit()
    while not table.results:
        (lease,) = leases(commands)
        table.finish(lease, InfraFailure(InfraCode.SLOT_CRASHED, "signal 11", "w2"))
        commands = table.apply(Tick(), after_s=6.0)
    assert table.results["b1-0"].outcome.worker_id == "w1"


def test_quick_worker_with_many_slots_holds_no_more_leases_than_its_messages_may_name(table):
    table.worker(slots=1000)
    (lease,) = leases(table.submit())
    table.finish(lease)
    assert table.dispatcher.workers["w1"].credits == HELD_LEASES


def test_failures_to_load_are_kept_for_a_minute_and_a_limited_number_of_scenes():
    failures = LoadFailures()
    for number in range(10 * LOAD_FAILURES_KEPT):
        failures.record(f"s{number}", "liar", "no mesh", float(number) / 1_000)
    assert len(failures.scenes()) == LOAD_FAILURES_KEPT
    failures.record("s1", "liar", "no mesh", 3.0)
    failures.record("s1", "w1", "no mesh", 30.0)
    failures.forget_old(80.0)
    assert failures.scenes() == ("s1",)
    failures.forget("s1")
    assert failures.scenes() == ()
