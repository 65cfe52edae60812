"""Run history: phase durations, events, and the archive of closed runs."""

import pytest
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import KITCHEN, batch, manager, open_run, outcomes, until

from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.run_log import EventKind, RolloutPhase
from embomatrix.rpc.wire.values import Batch, LookaheadEntry

pytestmark = pytest.mark.timeout(60)


async def test_every_phase_of_every_rollout_is_timed_once(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, FakeWorker(at.address, slots=2):
        results = await outcomes(client, batch(40))
        async with AdminClient(at.address) as logs:
            summary = await logs.run("r1")
    timings = [result.outcome.timings for result in results.values()]
    assert all(
        timing.execute_s == 0.001 and timing.deliver_s > 0 and timing.lease_s >= 0 for timing in timings
    )
    assert {phase: found.count for phase, found in summary.phases.items()} == dict.fromkeys(RolloutPhase, 40)
    sums = {phase: found.sum_s for phase, found in summary.phases.items()}
    assert sums[RolloutPhase.QUEUE] == pytest.approx(sum(timing.queued_s for timing in timings))
    assert sums[RolloutPhase.LEASE] == pytest.approx(sum(timing.lease_s for timing in timings))
    assert sums[RolloutPhase.DELIVER] == pytest.approx(sum(timing.deliver_s for timing in timings))


async def test_log_holds_begin_and_end_of_each_lease_in_order(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client:
        async with FakeWorker(at.address, slots=2, poison={"poison"}):
            good, bad = batch(10), batch(1, batch_id="b2", task="poison")
            await outcomes(client, Batch("r1", "mixed", 1, good.rollouts + bad.rollouts))
        async with AdminClient(at.address) as logs:
            events = await logs.all_events("r1")
            summary = await logs.run("r1")
            fleet = await logs.all_events()
    kinds = [event.kind for event in events]
    assert kinds[:2] == [EventKind.RUN_OPENED, EventKind.SUBMITTED]
    assert (kinds.count(EventKind.LEASED), kinds.count(EventKind.COMPLETED)) == (13, 10)
    assert kinds.count(EventKind.FAILED) == 3
    assert [event.sequence for event in events] == sorted({event.sequence for event in events})
    assert [event.at_s for event in events] == sorted(event.at_s for event in events)
    failed = [event for event in summary.failures if event.kind is EventKind.FAILED]
    assert [(event.rollout_id, event.attempt, event.code) for event in failed] == [
        ("b2-0", attempt, "slot_crashed") for attempt in (1, 2, 3)
    ]
    (ended,) = [event for event in events if event.kind is EventKind.ENDED]
    assert "attempt 3 of 3" in ended.message
    (worker,) = summary.workers
    assert (worker.worker_id, worker.completed, worker.failed) == ("w1", 10, 3)
    assert {EventKind.WORKER_JOINED, EventKind.SCENE_WARM} <= {event.kind for event in fleet}


async def test_closed_run_is_archived_with_log_and_counters(tmp_path):
    async with manager(tmp_path) as at, open_run(at.address) as client, AdminClient(at.address) as logs:
        async with FakeWorker(at.address) as worker:
            await client.announce_lookahead("r1", 1, [LookaheadEntry(1, KITCHEN, 8)])
            await until(lambda: worker.residents)
            await outcomes(client, batch(8))
            stats = await client.close_run("r1")
        assert await logs.list_runs() == ()
        (kept,) = await logs.list_runs(closed=True)
        assert (kept.run_id, kept.stats, kept.pending) == ("r1", stats, 0)
        assert kept.closed_s > kept.opened_s > 0
        summary = await logs.run("r1")
        assert summary.run == kept
        assert summary.prewarm_lead.count == stats.prewarm_hits
        assert sum(summary.series.completed) == 8
        events = await logs.all_events("r1")
        assert [event.kind for event in events].count(EventKind.COMPLETED) == 8
        assert events[-1].kind is EventKind.RUN_CLOSED
    async with manager(tmp_path) as at, AdminClient(at.address) as logs:
        assert (await logs.run("r1")).run == kept
        with pytest.raises(NotFoundError, match="no run 'r2' is open or kept"):
            await logs.run("r2")
