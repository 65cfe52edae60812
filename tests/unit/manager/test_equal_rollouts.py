"""Equal rollouts of a group: one execution, one outcome for each."""

import dataclasses

import pytest
from tests.fakes.dispatch import Table, crash, leases
from tests.fakes.worker import completed

from embomatrix.manager.control.dispatch.state import steps_of
from embomatrix.manager.control.events import BatchRestored, BatchSubmitted, RunOpened, Tick
from embomatrix.rpc.wire.values import Batch, Cancelled, GroupPolicy, InfraFailure, Rollout, RunTerms
from embomatrix.skills.syntax import Skill, SkillCall

PLAN = (SkillCall(Skill.MOVE, object_index=1), SkillCall(Skill.PICK_UP, object_index=1))
OTHER = (PLAN[0], PLAN[0])
GROUP = (
    Rollout("a", "g", "kitchen", "t", PLAN, 0, also=("b", "c")),
    Rollout("d", "g", "kitchen", "t", OTHER, 0),
)


@pytest.fixture
def table():
    return Table()


def submit(table, rollouts=GROUP):
    return leases(table.apply(BatchSubmitted(Batch("r1", "b1", 1, rollouts))))


def finish(table, lease, shared=0):
    outcome = completed(lease.worker_id, plan=lease.rollout.plan)
    table.finish(lease, dataclasses.replace(outcome, shared_steps=shared))


def test_equal_rollouts_get_one_lease_and_one_result_that_names_all(table):
    table.worker(slots=4)
    first, second = submit(table)
    assert table.dispatcher.pending_of("r1") == 4
    finish(table, first)
    assert table.dispatcher.pending_of("r1") == 1
    finish(table, second)
    result = table.results["a"]
    assert (result.cursor, result.also, result.count) == (1, ("b", "c"), 3)
    assert [one.rollout_id for one in result.each()] == ["a", "b", "c"]
    assert table.results["d"].cursor == 2
    counters = table.dispatcher.counters("r1")
    assert (counters.delivered, counters.warm_starts, counters.cold_starts) == (4, 4, 0)


def test_steps_of_equal_rollouts_count_as_shared(table):
    table.worker(slots=4)
    first, second = submit(table)
    for lease, shared in ((first, 1), (second, 0)):
        finish(table, lease, shared)
    counters = table.dispatcher.counters("r1")
    # The first plan has three rollouts: one of its two steps was known, and both steps of the two others.
    assert (counters.steps, counters.shared_steps) == (8, 5)


def test_lost_plan_is_the_loss_of_all_its_rollouts(table):
    table.apply(RunOpened("r1", RunTerms(GroupPolicy.FAIL_FAST)))
    table.worker(slots=4)
    first, _ = submit(table)
    table.finish(first, crash())
    assert isinstance(table.results["a"].outcome, InfraFailure)
    assert isinstance(table.results["d"].outcome, Cancelled)
    counters = table.dispatcher.counters("r1")
    assert (counters.delivered, counters.infra_failures, counters.groups_failed) == (4, 3, 1)


def test_restored_batch_continues_with_the_rollouts_that_have_no_result(table):
    table.worker(slots=4)
    table.apply(BatchRestored(Batch("r1", "b1", 1, GROUP), {"a": 1}, 1))
    assert table.dispatcher.pending_of("r1") == 1
    (lease,) = leases(table.apply(Tick(), after_s=10.0))
    finish(table, lease)
    assert list(table.results) == ["d"]
    assert table.results["d"].cursor == 2


def test_explanation_of_an_equal_rollout_names_the_executed_one(table):
    table.worker(slots=4)
    first, _ = submit(table)
    state = table.dispatcher.state
    assert state.batches_with("c") == {("r1", "b1")}
    assert state.where("c").startswith("leased:")
    finish(table, first)
    reasons = [step.reason for step in steps_of("c", state.history(), set())]
    assert "with a, whose plan is equal" in reasons
