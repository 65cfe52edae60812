"""A worker that executes nothing: it holds every scene warm and answers each lease with a result that was made before.

What a cluster costs beside its workers is measured with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.convert_outcome import completed_from_proto, completed_to_proto
from embomatrix.rpc.convert_session import (
    lease_ref_from_proto,
    lease_ref_to_proto,
    lease_result_to_proto,
    worker_state_to_proto,
)
from embomatrix.rpc.leases import LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.values import (
    Completed,
    Resident,
    ResidentState,
    Resources,
    Timings,
)
from embomatrix.skills.trace import Step
from embomatrix.worker.membership import Membership
from embomatrix.worker.session import HEARTBEAT_S, register

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from embomatrix.skills.syntax import Plan

NAME: Final = "hollow"
EXECUTE_S: Final = 0.0015
"""Told as the time of every execution: what a plan of the pinned workload takes."""
PAUSE_S: Final = 0.025
"""Between two messages with results."""
FINAL: Final = tuple(f"thing_{number}: on countertop_{number} in kitchen_0" for number in range(6))
MEMORY_MB: Final = 100_000


@dataclass(slots=True)
class HollowWorker:
    """What it was asked and how fast. While ``answering`` is cleared it keeps what it is given."""

    answering: asyncio.Event = field(default_factory=asyncio.Event)
    answered: int = 0
    waits_s: list[float] = field(default_factory=list)
    """From each message with results to the next one with leases: its slots could be idle for so long."""
    sent_s: float | None = None
    """When results went that no leases have followed."""

    def begin(self) -> None:
        """Forget the waits: while nothing is submitted, nothing can be leased."""
        self.waits_s.clear()
        self.sent_s = None


@contextlib.asynccontextmanager
async def hollow_worker(address: str, plan: Plan, slots: int) -> AsyncIterator[HollowWorker]:
    """It has joined the manager and stays for as long as this is held; its result is that of ``plan``, all of it done."""
    membership = Membership(address, NAME)
    registration = await register(membership, boot_id=NAME, resources=Resources(slots, slots, MEMORY_MB))
    worker = HollowWorker()
    worker.answering.set()
    async with open_channel(address) as channel:
        session = _HollowSession(worker, registration.session_id, registration.epoch, _result(plan))
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        tasks = [
            asyncio.create_task(session.talk(stub)),
            asyncio.create_task(session.answer()),
            asyncio.create_task(session.beat(stub, registration.heartbeat_s)),
        ]
        try:
            yield worker
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


class _HollowSession:
    def __init__(self, worker: HollowWorker, session_id: str, epoch: int, result: Completed) -> None:
        self._worker = worker
        self._session_id = session_id
        self._epoch = epoch
        self._result = result
        self._outgoing: asyncio.Queue[pb.SessionRequest] = asyncio.Queue()
        self._held: list[LeaseRef] = []
        self._given = asyncio.Event()

    async def talk(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub) -> None:
        self._outgoing.put_nowait(self._request(()))
        async for response in stub.Session(self._requests()):
            if response.HasField("desired"):
                self._outgoing.put_nowait(self._request(response.desired.bundle_digests))
            if response.leases:
                if self._worker.sent_s is not None:
                    self._worker.waits_s.append(time.perf_counter() - self._worker.sent_s)
                    self._worker.sent_s = None
                self._held += [lease_ref_from_proto(lease.ref) for lease in response.leases]
                self._given.set()

    async def answer(self) -> None:
        """Results many to a message, as a worker sends them that has enough ahead."""
        while True:
            await self._given.wait()
            await asyncio.sleep(PAUSE_S)
            await self._worker.answering.wait()
            self._given.clear()
            message = pb.SessionRequest(session_id=self._session_id, session_epoch=self._epoch)
            message.results.extend(
                lease_result_to_proto(LeaseResult(ref, self._result)) for ref in self._held
            )
            self._worker.answered += len(self._held)
            self._held.clear()
            self._worker.sent_s = time.perf_counter()
            self._outgoing.put_nowait(message)

    async def beat(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub, interval_s: float) -> None:
        while True:
            await asyncio.sleep(interval_s)
            running = [lease_ref_to_proto(ref) for ref in self._held]
            request = pb.HeartbeatRequest(
                session_id=self._session_id, session_epoch=self._epoch, running=running, load=1.0
            )
            await stub.Heartbeat(request, timeout=HEARTBEAT_S)

    async def _requests(self) -> AsyncIterator[pb.SessionRequest]:
        while True:
            yield await self._outgoing.get()

    def _request(self, digests: Sequence[str]) -> pb.SessionRequest:
        """The full state: the scenes are warm as soon as they are asked for."""
        residents = tuple(Resident(digest, ResidentState.WARM, 0.01, 1.0) for digest in digests)
        return pb.SessionRequest(
            session_id=self._session_id,
            session_epoch=self._epoch,
            state=worker_state_to_proto(WorkerState(residents, tuple(self._held))),
        )


def _result(plan: Plan) -> Completed:
    """A result of usual size, as a slot's process hands it to its daemon."""
    reward = RewardBreakdown(0.5, 0.4, 30.0, (AtomResult("(ontop thing_1 countertop_1)", True),), True)
    steps = tuple(Step(call, None, f"step {number} of the plan is done") for number, call in enumerate(plan))
    timings = Timings(execute_s=EXECUTE_S)
    completed = Completed(reward, steps, FINAL, "sha256:" + "0" * 64, NAME, timings, warm=True)
    return completed_from_proto(completed_to_proto(completed))
