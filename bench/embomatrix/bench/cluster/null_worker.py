"""Null worker: it executes nothing, holds every desired scene warm and answers each lease with a prepared result.

``python -m embomatrix.bench.cluster.null_worker ADDRESS SLOTS`` runs one and prints two numbers for each message with
leases: its time on the monotonic clock, and the seconds since the last message with results.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Final

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.outcome import completed_from_proto, completed_to_proto
from embomatrix.rpc.wire.rollout import unread_rollout
from embomatrix.rpc.wire.session import (
    lease_ref_from_proto,
    lease_ref_to_proto,
    lease_result_to_proto,
    worker_state_to_proto,
)
from embomatrix.rpc.wire.values import Completed, Resident, ResidentState, Resources, Rollout, Timings
from embomatrix.skills.syntax import Plan
from embomatrix.skills.trace import Step
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.session import HEARTBEAT_S, Registration, register

EXECUTE_S: Final = 0.0015
"""Reported execution time of every rollout: that of a plan of the pinned workload."""
PAUSE_S: Final = 0.025
"""Interval between two messages with results."""
FINAL: Final = tuple(f"thing_{number}: on countertop_{number} in kitchen_0" for number in range(6))
MEMORY_MB: Final = 100_000


async def register_null_worker(address: str, name: str, slots: int) -> Registration:
    """Register a worker with enough memory for every scene."""
    resources = Resources(slots, slots, MEMORY_MB)
    return await register(Membership(address, name), boot_id=name, resources=resources)


class NullWorker:
    """One session of a null worker. Unless it ``answers``, it keeps its leases and stays present.

    ``on_leases`` receives the time of each message with leases that follows results, and the seconds since those.
    """

    def __init__(
        self,
        registration: Registration,
        *,
        answers: bool = False,
        on_leases: Callable[[float, float], None] = lambda at_s, waited_s: None,
    ) -> None:
        self._registration = registration
        self._answers = answers
        self._on_leases = on_leases
        self._prepared: dict[Plan, Completed] = {}
        self._outgoing: asyncio.Queue[pb.SessionRequest] = asyncio.Queue()
        self._held: dict[LeaseRef, Rollout] = {}
        self._leased = asyncio.Event()
        self._sent_s: float | None = None
        """Time at which results were sent that no leases have followed."""

    async def run(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub, digests: Iterable[str]) -> None:
        """Hold these scenes and serve until cancelled."""
        self._send_state(digests)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._listen(stub))
            tasks.create_task(self._beat(stub))
            if self._answers:
                tasks.create_task(self._answer())

    async def _listen(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub) -> None:
        async for response in stub.Session(self._requests()):
            if response.HasField("desired"):
                self._send_state(response.desired.bundle_digests)
            if response.leases:
                now_s = time.monotonic()
                if self._sent_s is not None:
                    self._on_leases(now_s, now_s - self._sent_s)
                    self._sent_s = None
                self._held |= {
                    lease_ref_from_proto(lease.ref): unread_rollout(lease.rollout)
                    for lease in response.leases
                }
                self._leased.set()

    async def _answer(self) -> None:
        """Send many results in a message, as a worker does that has enough leases ahead."""
        while True:
            await self._leased.wait()
            await asyncio.sleep(PAUSE_S)
            self._leased.clear()
            message = self._request()
            message.results.extend(
                lease_result_to_proto(LeaseResult(ref, self._result_of(rollout.plan)))
                for ref, rollout in self._held.items()
            )
            self._held.clear()
            self._sent_s = time.monotonic()
            self._outgoing.put_nowait(message)

    def _result_of(self, plan: Plan) -> Completed:
        result = self._prepared.get(plan)
        if result is None:
            result = self._prepared[plan] = prepared_result(plan)
        return result

    async def _beat(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub) -> None:
        known = self._registration
        while True:
            await asyncio.sleep(known.heartbeat_s)
            running = [lease_ref_to_proto(ref) for ref in self._held]
            request = pb.HeartbeatRequest(
                session_id=known.session_id, session_epoch=known.epoch, running=running, load=1.0
            )
            await stub.Heartbeat(request, timeout=HEARTBEAT_S)

    async def _requests(self) -> AsyncIterator[pb.SessionRequest]:
        while True:
            yield await self._outgoing.get()

    def _send_state(self, digests: Iterable[str]) -> None:
        """Report the full state: desired scenes are warm at once."""
        residents = tuple(Resident(digest, ResidentState.WARM, 0.01, 1.0) for digest in digests)
        state = worker_state_to_proto(WorkerState(residents, tuple(self._held)))
        self._outgoing.put_nowait(self._request(state))

    def _request(self, state: pb.WorkerState | None = None) -> pb.SessionRequest:
        known = self._registration
        return pb.SessionRequest(session_id=known.session_id, session_epoch=known.epoch, state=state)


def prepared_result(plan: Plan) -> Completed:
    """Return a result of usual size, as a slot's process hands it to its daemon."""
    reward = RewardBreakdown(0.5, 0.0, 30.0, (AtomResult("(ontop thing_1 countertop_1)", True),), True)
    trace = tuple(Step(call, None, f"step {number} of the plan is done") for number, call in enumerate(plan))
    timings = Timings(execute_s=EXECUTE_S)
    completed = Completed(reward, trace, FINAL, "sha256:" + "0" * 64, "null", timings, warm=True)
    return completed_from_proto(completed_to_proto(completed))


async def main(address: str, slots: str) -> None:
    """Serve as one worker until killed."""
    registration = await register_null_worker(address, "null", int(slots))
    async with open_channel(address) as channel:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        await NullWorker(registration, answers=True, on_leases=_print).run(stub, ())


def _print(at_s: float, waited_s: float) -> None:
    sys.stdout.write(f"{at_s} {waited_s}\n")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
