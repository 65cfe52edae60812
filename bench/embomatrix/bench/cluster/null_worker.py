"""A worker that executes nothing: it holds every scene warm and answers each lease with a result that was made before.

What a cluster costs beside its workers is measured with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import time
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.host.parent import die_with_parent
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.outcome import completed_from_proto, completed_to_proto
from embomatrix.rpc.wire.session import (
    lease_ref_from_proto,
    lease_ref_to_proto,
    lease_result_to_proto,
    worker_state_to_proto,
)
from embomatrix.rpc.wire.values import (
    Completed,
    Resident,
    ResidentState,
    Resources,
    Timings,
)
from embomatrix.skills.trace import Step
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.session import HEARTBEAT_S, register

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from multiprocessing.connection import Connection

    from embomatrix.skills.syntax import Plan

NAME: Final = "hollow"
EXECUTE_S: Final = 0.0015
"""Told as the time of every execution: what a plan of the pinned workload takes."""
PAUSE_S: Final = 0.025
"""Between two messages with results."""
FINAL: Final = tuple(f"thing_{number}: on countertop_{number} in kitchen_0" for number in range(6))
MEMORY_MB: Final = 100_000
WORD_S: Final = 30.0
"""Limit for it to start and join, and to answer."""


class Order(StrEnum):
    """What a hollow worker is told; it answers each with its waits so far."""

    BEGIN = "begin"
    """Forget the waits: while nothing is submitted, nothing can be leased."""
    KEEP = "keep"
    """Answer nothing more, and keep what is given."""


class HollowWorker:
    """One in a process of its own: what the trainer does in this one shall not hold it up."""

    def __init__(self, orders: Connection) -> None:
        self._orders = orders

    async def hear(self) -> tuple[float, ...]:
        """Wait for its next word. Raises BenchError when there comes none."""
        try:
            if await asyncio.to_thread(self._orders.poll, WORD_S):
                return tuple(self._orders.recv())
        except EOFError:
            pass
        raise BenchError(f"the worker that executes nothing said nothing within {WORD_S:g} s, or died")

    async def tell(self, order: Order) -> tuple[float, ...]:
        """Its waits before this: seconds from each message with results to the next one with leases, in which its slots could
        be idle.
        """
        self._orders.send(order)
        return await self.hear()


@contextlib.asynccontextmanager
async def hollow_worker(address: str, plan: Plan, slots: int) -> AsyncIterator[HollowWorker]:
    """It has joined the manager and stays for as long as this is held; its result is that of ``plan``, all of it done."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, os.getpid(), address, plan, slots))
    process.start()
    theirs.close()
    try:
        worker = HollowWorker(ours)
        await worker.hear()
        yield worker
    finally:
        process.kill()
        process.join()
        ours.close()


def _work(orders: Connection, parent: int, address: str, plan: Plan, slots: int) -> None:
    die_with_parent(parent)
    asyncio.run(_serve(orders, address, plan, slots))


async def _serve(orders: Connection, address: str, plan: Plan, slots: int) -> None:
    """Join, say so, and work until the process is killed."""
    membership = Membership(address, NAME)
    registration = await register(membership, boot_id=NAME, resources=Resources(slots, slots, MEMORY_MB))
    async with open_channel(address) as channel, asyncio.TaskGroup() as tasks:
        session = _HollowSession(registration.session_id, registration.epoch, _result(plan))
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        tasks.create_task(session.talk(stub))
        tasks.create_task(session.answer())
        tasks.create_task(session.beat(stub, registration.heartbeat_s))
        orders.send(())
        asyncio.get_running_loop().add_reader(orders.fileno(), session.obey, orders)


class _HollowSession:
    def __init__(self, session_id: str, epoch: int, result: Completed) -> None:
        self._answering = asyncio.Event()
        self._answering.set()
        self._waits_s: list[float] = []
        self._sent_s: float | None = None
        """When results went that no leases have followed."""
        self._session_id = session_id
        self._epoch = epoch
        self._result = result
        self._outgoing: asyncio.Queue[pb.SessionRequest] = asyncio.Queue()
        self._held: list[LeaseRef] = []
        self._given = asyncio.Event()

    def obey(self, orders: Connection) -> None:
        """Take the order that has come."""
        order = orders.recv()
        orders.send(self._waits_s)
        if order is Order.BEGIN:
            self._waits_s, self._sent_s = [], None
        else:
            self._answering.clear()

    async def talk(self, stub: worker_service_pb2_grpc.WorkerServiceAsyncStub) -> None:
        self._outgoing.put_nowait(self._request(()))
        async for response in stub.Session(self._requests()):
            if response.HasField("desired"):
                self._outgoing.put_nowait(self._request(response.desired.bundle_digests))
            if response.leases:
                if self._sent_s is not None:
                    self._waits_s.append(time.perf_counter() - self._sent_s)
                    self._sent_s = None
                self._held += [lease_ref_from_proto(lease.ref) for lease in response.leases]
                self._given.set()

    async def answer(self) -> None:
        """Results many to a message, as a worker sends them that has enough ahead."""
        while True:
            await self._given.wait()
            await asyncio.sleep(PAUSE_S)
            await self._answering.wait()
            self._given.clear()
            message = pb.SessionRequest(session_id=self._session_id, session_epoch=self._epoch)
            message.results.extend(
                lease_result_to_proto(LeaseResult(ref, self._result)) for ref in self._held
            )
            self._held.clear()
            self._sent_s = time.perf_counter()
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
