"""Outbox of a worker's stream."""

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.runtime.worker_link import WorkerLink
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Resources


async def test_commands_of_one_moment_leave_in_one_message():
    session, _ = Registry(LivenessLimits()).register("w1", "boot", Resources(1, 1, 1024), now_s=0.0)
    link = WorkerLink(session)
    link.put(AcknowledgeLease("w1", LeaseRef("l-1", 1)))
    link.put(CancelLease("w1", LeaseRef("l-2", 2)))
    outbox = await link.take()
    assert (outbox.acknowledged, outbox.cancelled) == ([LeaseRef("l-1", 1)], [LeaseRef("l-2", 2)])
