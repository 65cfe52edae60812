"""Worker for the manager's tests: speaks the whole protocol, executes nothing, and misbehaves on request."""

import asyncio
import contextlib
import dataclasses
from dataclasses import dataclass, field

import grpc

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.leases import LeaseResult, WorkerState
from embomatrix.rpc.wire.session import (
    host_use_to_proto,
    lease_from_proto,
    lease_ref_from_proto,
    lease_ref_to_proto,
    lease_result_to_proto,
    resources_to_proto,
    worker_state_to_proto,
)
from embomatrix.rpc.wire.values import (
    Completed,
    HostUse,
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Resources,
    Timings,
)
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import Advice, TurnObservation


def completed(worker_id="w1", reward=PAPER, plan=(), holds=(True, False)):
    """Return the outcome of a plan whose calls all succeed; ``holds`` gives the truth of the goal's atoms."""
    steps = tuple(Step(call, None, "done") for call in plan)
    touched = {call.object_index for call in plan} | {call.source_index for call in plan}
    relevance = min(reward.relevance_limit, reward.relevance_per_object * len(touched - {None}))
    atoms = tuple(AtomResult(f"atom {number}", truth) for number, truth in enumerate(holds))
    scored = RewardBreakdown(
        reward.format, relevance, reward.goal * sum(holds) / len(holds), atoms, success=all(holds)
    )
    return Completed(scored, steps, (), "sha256:trace", worker_id, Timings(execute_s=0.001), warm=True)


def completed_turn(turn, worker_id="w1", reward=PAPER):
    """Return the outcome of a turn whose new calls all succeed, after a prefix with the failures that it names."""
    done = tuple(call for index, call in enumerate(turn.plan) if index not in turn.prefix.failed)
    whole = completed(worker_id, reward, done)
    further = turn.plan[turn.prefix.length :]
    return dataclasses.replace(
        whole,
        steps=whole.steps[len(done) - len(further) :],
        trace_digest=f"sha256:{len(turn.plan)}",
        observation=TurnObservation(
            "kitchen_0",
            (),
            (f"{len(turn.plan)} calls",),
            turn.sight,
            (0, 2) if turn.sight else (),
            Advice(turn.plan[:1]) if turn.advise else None,
        ),
    )


@dataclass
class FakeWorker:
    """Async context manager. ``poison`` tasks crash their slot, ``stuck`` tasks never end, ``broken`` scenes don't load."""

    address: str
    worker_id: str = "w1"
    slots: int = 1
    memory_mb: int = 1024
    scene_mb: float = 10.0
    load_s: float = 0.0
    execute_s: float = 0.0
    token: str = ""
    join_token: str = ""
    ca: bytes = b""
    protocol: int = PROTOCOL_VERSION
    boot_id: str = ""
    poison: set = field(default_factory=set)
    stuck: set = field(default_factory=set)
    broken: set = field(default_factory=set)
    fetched: list = field(default_factory=list)
    executed: list = field(default_factory=list)
    desired: tuple = ()
    leases: dict = field(default_factory=dict)
    portions: list = field(default_factory=list)
    """Number of leases in each message with leases."""
    acknowledged: list = field(default_factory=list)
    cancelled: list = field(default_factory=list)
    residents: dict = field(default_factory=dict)
    paused: str = ""
    lies: bool = False
    """True if it reports that plans reached nothing of their goal."""
    old: bool = False
    """True if it executes turns like other rollouts, as a worker does that does not know them."""
    blind: bool = False
    """True if it says neither what the robot sees nor what the oracle advises, as a worker does that knows neither."""
    strange: bool = False
    """True if prefixes of turns have other digests here, as on another platform."""
    resumed: bool = False
    labels: dict = field(default_factory=dict)
    host: HostUse | None = None
    """Use of its machine in every heartbeat."""
    log_lines: list = field(default_factory=list)
    """Lines of its log for the next heartbeat."""

    async def __aenter__(self):
        self._channel = open_channel(self.address, self.token, self.ca)
        self._stub = worker_service_pb2_grpc.WorkerServiceStub(self._channel)
        self._outgoing = asyncio.Queue()
        self._free = asyncio.Queue()
        for slot in range(1, self.slots + 1):
            self._free.put_nowait(slot)
        self._tasks = set()
        answer = await self._stub.Register(
            pb.RegisterRequest(
                worker_id=self.worker_id,
                boot_id=self.boot_id,
                protocol_version=self.protocol,
                join_token=self.join_token,
                resources=resources_to_proto(
                    Resources(self.slots, self.slots, self.memory_mb, labels=self.labels)
                ),
            ),
            timeout=5,
        )
        self.session = (answer.session_id, answer.session_epoch)
        if answer.credential:
            await self._channel.close()
            self.token = answer.credential
            self._channel = open_channel(self.address, self.token, self.ca)
            self._stub = worker_service_pb2_grpc.WorkerServiceStub(self._channel)
        self._send(state=self._state())
        self._start(self._talk)
        self._start(self._beat, answer.heartbeat_interval_s)
        return self

    async def __aexit__(self, *_):
        await self.kill()

    async def kill(self):
        """Disconnect without a message, like a killed process."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._channel.close()

    def report(self, ref, outcome, slot=0):
        """Send a result even if its lease has ended; without a slot, as for a rollout that never ran."""
        self._send(results=[LeaseResult(ref, outcome, slot=slot, held_s=self.execute_s if slot else 0.0)])

    def finish_all(self):
        """Send the results of all held leases in one message and return their number."""
        held, self.leases = self.leases, {}
        if held:
            self._send(
                results=[
                    LeaseResult(lease.ref, completed(self.worker_id, plan=lease.rollout.plan))
                    for lease in held.values()
                ]
            )
        return len(held)

    def pause(self, reason):
        """Report a pause with this reason; an empty reason resumes."""
        self.paused = reason
        self._send(state=self._state())

    def _start(self, work, *given):
        task = asyncio.create_task(self._until_the_manager_goes(work, *given))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _until_the_manager_goes(self, work, *given):
        with contextlib.suppress(grpc.aio.AioRpcError):
            await work(*given)

    def _state(self):
        held = tuple(lease.ref for lease in self.leases.values())
        return WorkerState(tuple(self.residents.values()), held, paused=self.paused)

    def _send(self, state=None, results=()):
        session_id, epoch = self.session
        request = pb.SessionRequest(session_id=session_id, session_epoch=epoch)
        if state is not None:
            request.state.CopyFrom(worker_state_to_proto(state))
        request.results.extend(lease_result_to_proto(result) for result in results)
        self._outgoing.put_nowait(request)

    async def _requests(self):
        while True:
            yield await self._outgoing.get()

    async def _talk(self):
        async for response in self._stub.Session(self._requests()):
            if response.HasField("desired"):
                self._want(tuple(response.desired.bundle_digests))
            self.resumed = self.resumed or response.resume
            if response.leases:
                self.portions.append(len(response.leases))
            for message in response.leases:
                lease = lease_from_proto(message)
                self.leases[lease.ref.lease_id] = lease
                self._start(self._execute, lease)
            self.acknowledged += map(lease_ref_from_proto, response.acknowledged)
            for message in response.cancelled:
                self.cancelled.append(lease_ref_from_proto(message))
                self.leases.pop(message.lease_id, None)

    def _want(self, digests):
        self.desired = digests
        for digest in set(self.residents) - set(digests):
            del self.residents[digest]
        for digest in digests:
            if digest not in self.residents:
                self.residents[digest] = Resident(digest, ResidentState.LOADING, 0.0, self.scene_mb)
                self._start(self._load, digest)
        self._send(state=self._state())

    async def _load(self, digest):
        request = pb.FetchBundleRequest(session_id=self.session[0], bundle_digest=digest)
        with contextlib.suppress(Exception):
            data = b"".join([part.chunk async for part in self._stub.FetchBundle(request, timeout=5)])
            self.fetched.append((digest, data))
        await asyncio.sleep(self.load_s)
        if digest not in self.desired:
            return
        failed = digest in self.broken
        state = ResidentState.FAILED if failed else ResidentState.WARM
        error = "the mesh has no triangles" if failed else ""
        self.residents[digest] = Resident(digest, state, max(self.load_s, 0.001), self.scene_mb, error)
        self._send(state=self._state())

    async def _execute(self, lease):
        slot = await self._free.get()
        try:
            await self._execute_in(slot, lease)
        finally:
            self._free.put_nowait(slot)

    async def _execute_in(self, slot, lease):
        if lease.ref.lease_id not in self.leases:
            return
        self.executed.append(lease.rollout.rollout_id)
        if lease.rollout.task_id in self.stuck:
            await asyncio.Event().wait()
        await asyncio.sleep(self.execute_s)
        if self.leases.pop(lease.ref.lease_id, None) is None:
            return
        if lease.rollout.task_id in self.poison:
            crashed = InfraFailure(InfraCode.SLOT_CRASHED, "signal 11", self.worker_id)
            self.report(lease.ref, crashed, slot)
        elif lease.rollout.is_turn and self.strange and lease.rollout.prefix.digest:
            mismatch = InfraFailure(InfraCode.PREFIX_MISMATCH, "expected a, found b", self.worker_id)
            self.report(lease.ref, mismatch, slot)
        elif lease.rollout.is_turn and not self.old:
            asked = lease.rollout
            turn = dataclasses.replace(
                asked, sight=asked.sight > self.blind, advise=asked.advise > self.blind
            )
            self.report(lease.ref, completed_turn(turn, self.worker_id, lease.reward), slot)
        else:
            holds = (False, False) if self.lies else (True, False)
            outcome = completed(self.worker_id, lease.reward, lease.rollout.plan, holds)
            self.report(lease.ref, outcome, slot)

    async def _beat(self, interval_s):
        while True:
            await asyncio.sleep(interval_s)
            running = [lease_ref_to_proto(lease.ref) for lease in self.leases.values()]
            lines, self.log_lines = self.log_lines, []
            await self._stub.Heartbeat(
                pb.HeartbeatRequest(
                    session_id=self.session[0],
                    session_epoch=self.session[1],
                    running=running,
                    host=host_use_to_proto(self.host) if self.host is not None else None,
                    log_lines=lines,
                ),
                timeout=5,
            )
