"""Turns of episodes in the dispatcher: independent of each other, tried on one other worker after a mismatch, and forgotten."""

import pytest
from tests.fakes.dispatch import Table, crash, leases
from tests.fakes.living import alive
from tests.fakes.worker import completed, completed_turn

from embomatrix.manager.control.dispatch.batches import FINISHED_KEPT
from embomatrix.manager.control.dispatch.leases import ENDED_KEPT
from embomatrix.manager.control.dispatch.records import BatchRecord, LeaseRecord
from embomatrix.manager.control.events import BatchSubmitted, LookaheadAnnounced, RunOpened
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits, Scheduler
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
)
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.turns import EpisodePrefix

CALL = SkillCall(Skill.MOVE, object_index=1)
MISMATCH = InfraFailure(InfraCode.PREFIX_MISMATCH, "expected a, found b")


def turn_batch(count=1, batch_id="turns-1"):
    turns = tuple(
        Rollout(
            f"{batch_id}.{n}", f"{batch_id}.{n}", "kitchen", "t", (CALL, CALL), 0, prefix=EpisodePrefix(1)
        )
        for n in range(count)
    )
    return Batch("r1", batch_id, 0, turns)


def answered(table, commands):
    for lease in leases(commands):
        table.finish(lease, completed_turn(lease.rollout, lease.worker_id))


@pytest.fixture
def table():
    return Table()


def test_finished_turns_are_forgotten_while_an_older_batch_runs(table):
    table.worker(slots=2)
    (endless,) = leases(table.submit(batch_id="endless"))
    before = {kind: alive(kind) for kind in (BatchRecord, LeaseRecord)}
    for number in range(3 * ENDED_KEPT):
        answered(table, table.apply(BatchSubmitted(turn_batch(batch_id=f"turns-{number}")), after_s=0.001))
    table.results.clear()
    assert alive(BatchRecord) - before[BatchRecord] <= FINISHED_KEPT + 2
    assert alive(LeaseRecord) - before[LeaseRecord] <= ENDED_KEPT + 2
    table.finish(endless, completed())
    assert isinstance(table.results["endless-0"].outcome, Completed)
    table.dispatcher.state.check_invariants()


@pytest.mark.parametrize("policy", GroupPolicy)
def test_turn_fails_alone_after_all_attempts_under_every_policy(table, policy):
    table.worker(slots=2)
    table.apply(RunOpened("r1", RunTerms(policy)))
    bad, good = leases(table.apply(BatchSubmitted(turn_batch(2))))
    for attempt in range(1, 4):
        (bad,) = leases(table.finish(bad, crash())) or (None,)
        assert (bad is None) == (attempt == 3)
    assert table.results["turns-1.0"].outcome.code is InfraCode.SLOT_CRASHED
    answered(table, [good])
    assert isinstance(table.results["turns-1.1"].outcome, Completed)
    assert not any(isinstance(result.outcome, Cancelled) for result in table.results.values())


def test_mismatch_on_the_only_worker_ends_the_turn(table):
    table.worker()
    (lease,) = leases(table.apply(BatchSubmitted(turn_batch())))
    assert leases(table.finish(lease, MISMATCH)) == []
    assert table.results["turns-1.0"].outcome.message == "expected a, found b (attempt 1 of 1)"


def test_mismatch_is_tried_on_one_other_worker(table):
    for name in ("w1", "w2", "w3"):
        table.worker(name)
    (first,) = leases(table.apply(BatchSubmitted(turn_batch())))
    (second,) = leases(table.finish(first, MISMATCH))
    assert second.worker_id != first.worker_id
    assert leases(table.finish(second, MISMATCH)) == []
    assert table.results["turns-1.0"].outcome.code is InfraCode.PREFIX_MISMATCH


def test_turns_leave_the_look_ahead_window_as_it_is(table):
    scheduler = Scheduler(ScheduleLimits(), table.dispatcher.workers)
    scheduler.note(LookaheadAnnounced("r1", 1, (LookaheadEntry(0, "kitchen", 2),)), now_s=0.0)
    scheduler.note(BatchSubmitted(turn_batch(2)), now_s=0.1)
    assert scheduler.windows["r1"].entries == (LookaheadEntry(0, "kitchen", 2),)
