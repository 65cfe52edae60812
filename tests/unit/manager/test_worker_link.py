"""Outbox of a worker's stream."""

import asyncio

import pytest

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.runtime.worker_link import ACKNOWLEDGE_S, WorkerLink
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Resources


async def test_commands_of_one_moment_leave_in_one_message():
    session, _ = Registry(LivenessLimits()).register("w1", "boot", Resources(1, 1, 1024), now_s=0.0)
    link = WorkerLink(session)
    link.put(AcknowledgeLease("w1", LeaseRef("l-1", 1)))
    link.put(CancelLease("w1", LeaseRef("l-2", 2)))
    outbox = await link.take()
    assert (outbox.acknowledged, outbox.cancelled) == ([LeaseRef("l-1", 1)], [LeaseRef("l-2", 2)])


async def test_lone_acknowledgement_leaves_after_a_moment():
    session, _ = Registry(LivenessLimits()).register("w1", "boot", Resources(1, 1, 1024), now_s=0.0)
    link = WorkerLink(session)
    for number in range(3):
        link.put(AcknowledgeLease("w1", LeaseRef(f"l-{number}", number)))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(link.take(), ACKNOWLEDGE_S / 4)
    outbox = await asyncio.wait_for(link.take(), 100 * ACKNOWLEDGE_S)
    assert len(outbox.acknowledged) == 3
