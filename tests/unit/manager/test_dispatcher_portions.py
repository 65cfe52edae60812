"""Large batches that are queued in pieces: cancellation, failure and deadline of the rest."""

from dataclasses import replace

import pytest
from tests.fakes.dispatch import LIMITS, Table, crash, leases

from embomatrix.manager.control.commands import FinishBatch
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchContinued,
    Tick,
)
from embomatrix.rpc.wire.values import (
    Cancelled,
    InfraCode,
)


@pytest.fixture
def table():
    return Table()


def test_large_batch_is_queued_in_pieces_and_finishes_after_the_last(table):
    table.worker(slots=1)
    first = leases(table.submit_in_pieces(5, 2))
    assert [lease.rollout.rollout_id for lease in first] == ["b1-0", "b1-1"]
    assert (table.dispatcher.queued, table.dispatcher.pending_of("r1")) == (3, 5)
    for lease in first:
        assert not [command for command in table.finish(lease) if isinstance(command, FinishBatch)]
    rest = leases(table.apply(BatchContinued("r1", "b1", 2)))
    assert [lease.rollout.rollout_id for lease in rest] == ["b1-2", "b1-3"]
    table.finish(rest[0])
    (last,) = leases(table.apply(BatchContinued("r1", "b1", 2)))
    table.finish(rest[1])
    assert table.finish(last)[-1] == FinishBatch("r1", "b1")
    assert sorted(table.results) == [f"b1-{i}" for i in range(5)]


def test_rollouts_still_coming_are_cancelled_with_their_batch(table):
    table.worker(slots=1)
    table.submit_in_pieces(5, 2)
    commands = table.apply(BatchCancelled("r1", "b1"))
    assert commands.count(FinishBatch("r1", "b1")) == 1
    assert {type(result.outcome) for result in table.results.values()} == {Cancelled}
    assert len(table.results) == 5
    assert table.apply(BatchContinued("r1", "b1", 2)) == []


def test_members_still_coming_fail_with_their_group_and_others_are_queued():
    table = Table(replace(LIMITS, max_attempts=1))
    table.worker(slots=1)
    (lease, *_) = leases(table.submit_in_pieces(6, 2, group_size=3))
    given = leases(table.finish(lease, crash()))
    assert sorted(table.results) == ["b1-0", "b1-1", "b1-2"]
    assert [lease.rollout.rollout_id for lease in given] == ["b1-3", "b1-4"]
    assert table.apply(BatchContinued("r1", "b1", 4)) == []


def test_batch_deadline_fails_rollouts_still_coming(table):
    table.submit_in_pieces(3, 1)
    table.apply(Tick(), after_s=601.0)
    assert {result.outcome.code for result in table.results.values()} == {InfraCode.DEADLINE}
    assert len(table.results) == 3


def test_second_batch_queues_behind_all_of_a_partly_queued_one(table):
    table.submit_in_pieces(3, 1)
    table.submit(1, batch_id="b2")
    table.apply(BatchContinued("r1", "b1", 2))
    (lease, second) = leases(table.worker(slots=1))
    assert [lease.rollout.rollout_id, second.rollout.rollout_id] == ["b1-0", "b1-1"]
