"""Large batches are queued in slices."""

import asyncio
import contextlib

from embomatrix.manager.control.events import BatchContinued, BatchSubmitted
from embomatrix.manager.runtime.runs import PIECE, Submissions
from embomatrix.rpc.wire.values import Batch, Rollout


def batch(name, count):
    return Batch("r1", name, 1, tuple(Rollout(f"x{i}", "g", "kitchen", "t", (), 0) for i in range(count)))


async def events_of(batches):
    """Return the events of these batches, which arrive at the same time."""
    events = []
    submissions = Submissions(events.append)
    serving = asyncio.create_task(submissions.serve())
    for one in batches:
        submissions.enter(one)
    for _ in range(20):
        await asyncio.sleep(0)
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    return events


async def test_small_batch_is_queued_at_once():
    small = batch("b1", PIECE)
    assert await events_of([small]) == [BatchSubmitted(small, PIECE)]


async def test_concurrent_large_batches_take_turns():
    large, larger = batch("b1", 2 * PIECE + 1), batch("b2", 3 * PIECE)
    assert await events_of([large, larger]) == [
        BatchSubmitted(large, PIECE),
        BatchSubmitted(larger, PIECE),
        *(BatchContinued("r1", name, PIECE) for name in ("b1", "b2", "b1", "b2")),
    ]
