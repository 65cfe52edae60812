"""What waits to be said to a worker."""

import asyncio

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.runtime.worker_link import WorkerLink
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Resources

FIRST, SECOND = LeaseRef("l-1", 1), LeaseRef("l-2", 2)


def link():
    session, _ = Registry(LivenessLimits()).register("w1", "boot", Resources(1, 1, 1024), now_s=0.0)
    return WorkerLink(session)


async def test_an_acknowledgement_goes_with_whatever_is_said_next():
    to_worker = link()
    taking = asyncio.create_task(to_worker.take())
    to_worker.put(AcknowledgeLease("w1", FIRST))
    for _ in range(5):
        await asyncio.sleep(0)
    assert not taking.done()
    to_worker.put(CancelLease("w1", SECOND))
    outbox = await taking
    assert (outbox.acknowledged, outbox.cancelled) == ([FIRST], [SECOND])


async def test_an_acknowledgement_goes_alone_when_nothing_else_is_to_be_said():
    to_worker = link()
    for ref in (FIRST, SECOND):
        to_worker.put(AcknowledgeLease("w1", ref))
        async with asyncio.timeout(30.0):
            assert (await to_worker.take()).acknowledged == [ref]
