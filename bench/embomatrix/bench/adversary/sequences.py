"""Sequences of any messages in any order, by hostile workers and a hostile trainer beside an honest run.

``python -m embomatrix.bench.adversary.sequences SEED [STEPS]`` plays one and prints its steps. Equal seeds play equal
sequences: the manager is inside this process, and nothing else decides the order.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import random
import sys
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.adversary import browser_kinds as _browser_kinds
from embomatrix.bench.adversary import trainer_kinds as _trainer_kinds
from embomatrix.bench.adversary.inside import ADMIN, ManagerInside, OpenCall, manager_inside, run_in_order
from embomatrix.bench.adversary.kinds import KINDS, AttackerRole, Kind, Knowledge, Payload
from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.bench.adversary.worker_kinds import SESSION, first_state, sound_registration
from embomatrix.bench.cluster.null_worker import NullWorker, prepared_result
from embomatrix.bench.engine.workload import PINNED, load_workload
from embomatrix.proto.v1 import admin_service_pb2, rollout_service_pb2, types_pb2
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.run import run_terms_to_proto
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import (
    Completed,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    RolloutResult,
    RunTerms,
)
from embomatrix.worker.link.session import Registration

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload

_ = (_browser_kinds, _trainer_kinds)

HONEST: Final = 2
FOES: Final = 2
ROLLOUTS: Final = 6
RUN: Final = "honest"
STREAMS: Final = 3
"""Session streams that a hostile worker holds open at most."""
FINISH_S: Final = 20.0
"""Time for the honest run after the last hostile message."""
PAUSES_S: Final = (0.0, 0.001, 0.001, 0.001, 0.05)
"""Pauses after a message: none, until the manager is idle, or until honest workers have answered. See ``run_in_order``."""
LARGE: Final = 200_000
"""Strikes with more bytes than this are skipped. The siege sends them."""


@dataclass
class Played:
    """Sequence that was played: its steps, the statuses of its calls, and its harm."""

    steps: list[str] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    right: int = 0
    """Honest rollouts that were delivered with the honest result."""
    disputed: int = 0
    """Honest rollouts without a reward, because an honest and two hostile workers contradict each other."""
    fabricated: int = 0
    """Honest rollouts that were delivered with another result."""
    tracebacks: list[str] = field(default_factory=list)
    """Unexpected errors of the manager."""

    @property
    def outcomes(self) -> int:
        return self.right + self.disputed + self.fabricated

    def note(self, step: str, status: str = "") -> None:
        self.steps.append(f"{step}: {status}" if status else step)
        if status:
            self.statuses[status] += 1


class _Foe:
    """Hostile worker with its own name, credential, and session streams in any state."""

    def __init__(self, known: Knowledge, maker: MessageMaker, rng: random.Random) -> None:
        self.known = known
        self.maker = maker
        self.rng = rng
        self.streams: list[OpenCall] = []

    def listen(self) -> None:
        """Learn the leases in the answers, and forget most streams that the manager ended."""
        for stream in self.streams:
            for data in stream.taken():
                for lease in pb.SessionResponse.FromString(data).leases:
                    self.known.leases.append(lease)
                    self.known.foreign.append(lease.ref)
                    self.maker.known.append(lease.ref.lease_id)
        del self.maker.known[:-64]
        self.streams = [each for each in self.streams if not each.task.done() or self.rng.random() < 0.1]


def _payloads(kind: Kind, known: Knowledge, maker: MessageMaker) -> list[bytes]:
    made: Sequence[Payload] = kind.make(known, maker)
    return [payload if isinstance(payload, bytes) else payload.SerializeToString() for payload in made]


class _Stage:
    """Manager, honest workers and attackers of one sequence."""

    def __init__(
        self, manager: ManagerInside, workload: Workload, rng: random.Random, played: Played
    ) -> None:
        self.manager = manager
        self.rng = rng
        self.played = played
        self.rollouts = [rollout_to_proto(rollout) for rollout in workload.rollouts[:8]]
        self.digests = sorted({rollout.bundle_digest for rollout in self.rollouts})
        self.foes: list[_Foe] = []
        self.trainer = Knowledge(run_id="hostile", rollouts=self.rollouts)
        # It does not know the id of the honest run, since any trainer's token may close any run.
        self.trainer_maker = MessageMaker(rng, ["hostile", self.rollouts[0].bundle_digest])
        self.ended: Counter[str] = Counter()
        """Number of times that the manager ended a session after a message, by its kind."""
        of_worker = [kind for kind in KINDS.values() if kind.actor is AttackerRole.WORKER]
        self.session_kinds = [kind for kind in of_worker if kind.method == SESSION]
        self.call_kinds = [kind for kind in of_worker if kind.method != SESSION]
        self.trainer_kinds = [kind for kind in KINDS.values() if kind.actor is AttackerRole.TRAINER]

    async def join(self) -> str:
        return (await self.manager.gate.issue(AccessRole.JOIN, valid_s=600.0, label=""))[0]

    async def enter(self) -> None:
        """Open the hostile trainer's run and register the hostile workers."""
        self.trainer.token = (await self.manager.gate.issue(AccessRole.TRAINER, valid_s=0.0, label=""))[0]
        opening = rollout_service_pb2.OpenRunRequest(
            name="hostile", run_id="hostile", protocol_version=PROTOCOL_VERSION
        )
        await self.manager.call("RolloutService/OpenRun", self.trainer.token, [opening.SerializeToString()])
        for number in range(FOES):
            known = Knowledge(worker_id=f"foe-{number}", run_id=RUN, rollouts=self.rollouts)
            foe = _Foe(known, MessageMaker(self.rng, [known.worker_id, RUN]), self.rng)
            self.foes.append(foe)
            await self._register(foe)

    async def _register(self, foe: _Foe) -> None:
        """Register under the foe's name, with its credential or a new join token."""
        invitation = "" if foe.known.token else await self.join()
        request = sound_registration(foe.known, invitation)
        status, answers = await self.manager.call(
            "WorkerService/Register", foe.known.token, [request.SerializeToString()]
        )
        self.played.note(f"{foe.known.worker_id} registers", status)
        if answers:
            answer = pb.RegisterResponse.FromString(answers[0])
            foe.known.session_id, foe.known.epoch = answer.session_id, answer.session_epoch
            foe.known.token = answer.credential or foe.known.token
            foe.known.leases.clear()
            foe.maker.known.append(answer.session_id)

    async def step(self) -> None:
        """Do one hostile thing."""
        foe = self.rng.choice(self.foes)
        foe.listen()
        match self.rng.choices(range(5), (50, 12, 6, 4, 16))[0]:
            case 0 if foe.streams:
                await self._send(foe, self.rng.choice(foe.streams), self._session_kind(), "sends")
            case 2:
                await self._register(foe)
            case 3 if foe.streams:
                self._close(foe)
            case 4:
                await self._call(self.rng.choice(self.trainer_kinds), self.trainer, self.trainer_maker)
            case 1 if foe.streams:
                await self._call(self.rng.choice(self.call_kinds), foe.known, foe.maker)
            case _:
                await self._open(foe)
        self.manager.runtime.cluster.check_invariants()

    def _session_kind(self) -> Kind:
        """Draw a kind of message. Kinds that ended sessions are drawn less often, so that sessions last longer."""
        weights = [1 / (1 + self.ended[kind.name]) for kind in self.session_kinds]
        return self.rng.choices(self.session_kinds, weights)[0]

    async def _open(self, foe: _Foe) -> None:
        """Open a session stream with a sound state, or with any message."""
        if len(foe.streams) >= STREAMS:
            foe.streams.pop(self.rng.randrange(len(foe.streams))).close()
        stream = self.manager.open(SESSION, foe.known.token)
        foe.streams.append(stream)
        if self.rng.random() < 0.4:
            stream.send(first_state(foe.known).SerializeToString())
            self.played.note(f"{foe.known.worker_id} opens a session")
        else:
            await self._send(foe, stream, self._session_kind(), "opens a session with")

    async def _send(self, foe: _Foe, stream: OpenCall, kind: Kind, verb: str) -> None:
        payloads = _payloads(kind, foe.known, foe.maker)
        if sum(map(len, payloads)) > LARGE:
            return
        was_open = not stream.status
        for payload in payloads:
            stream.send(payload)
        await asyncio.sleep(self.rng.choice(PAUSES_S))
        self.ended[kind.name] += was_open and bool(stream.status)
        self.played.note(f"{foe.known.worker_id} {verb} {kind.name}", stream.status)

    def _close(self, foe: _Foe) -> None:
        stream = foe.streams.pop(self.rng.randrange(len(foe.streams)))
        if self.rng.random() < 0.5:
            stream.close()
        else:
            stream.task.cancel()
        self.played.note(f"{foe.known.worker_id} closes a session", stream.status)

    async def _call(self, kind: Kind, known: Knowledge, maker: MessageMaker) -> None:
        payloads = _payloads(kind, known, maker)
        if sum(map(len, payloads)) > LARGE:
            return
        stream = self.manager.open(kind.method, known.token)
        for payload in payloads:
            stream.send(payload)
        stream.close()
        # Streams of results have no end while their rollouts wait.
        await asyncio.wait([stream.task], timeout=self.rng.choice(PAUSES_S))
        stream.task.cancel()
        await asyncio.wait([stream.task])
        self.played.note(f"{known.worker_id or 'trainer'} calls {kind.name}", stream.status)

    async def leave(self) -> None:
        """Expel the hostile workers, as an operator does; their leases go to the honest ones."""
        for foe in self.foes:
            for stream in foe.streams:
                stream.task.cancel()
            await asyncio.gather(*(stream.task for stream in foe.streams), return_exceptions=True)
            request = admin_service_pb2.RevokeWorkerRequest(worker_id=foe.known.worker_id)
            await self.manager.call("AdminService/RevokeWorker", ADMIN, [request.SerializeToString()])


class _HonestStub:
    """Calls of an honest worker, in the form of a gRPC stub."""

    def __init__(self, manager: ManagerInside, token: str) -> None:
        self._manager = manager
        self._token = token

    async def Session(self, requests: AsyncIterator[pb.SessionRequest]) -> AsyncIterator[pb.SessionResponse]:  # noqa: N802  # gRPC's name
        stream = self._manager.open(SESSION, self._token)

        async def send() -> None:
            async for request in requests:
                stream.send(request.SerializeToString())

        sending = asyncio.create_task(send())
        try:
            while not stream.task.done():
                for data in await stream.more():
                    yield pb.SessionResponse.FromString(data)
        finally:
            sending.cancel()
            stream.task.cancel()
        raise AssertionError(f"the session of an honest worker ended with {stream.status}")

    async def Heartbeat(self, request: pb.HeartbeatRequest, timeout: float) -> None:  # noqa: N802  # gRPC's name
        del timeout
        await self._manager.call("WorkerService/Heartbeat", self._token, [request.SerializeToString()])


async def _honest_worker(manager: ManagerInside, name: str, invitation: str, digests: Sequence[str]) -> None:
    """Serve as an honest worker until cancelled. Raise AssertionError if the manager ends its session."""
    known = Knowledge(worker_id=name)
    request = sound_registration(known, invitation)
    status, answers = await manager.call("WorkerService/Register", "", [request.SerializeToString()])
    assert status == "OK", status
    answer = pb.RegisterResponse.FromString(answers[0])
    registration = Registration(
        answer.session_id, answer.session_epoch, answer.heartbeat_interval_s, answer.lease_ttl_s
    )
    stub: Any = _HonestStub(manager, answer.credential)
    await NullWorker(registration, answers=True).run(stub, digests)


async def _honest_run(manager: ManagerInside, rollouts: Sequence[types_pb2.Rollout], played: Played) -> None:
    """Execute a verified run, and count the rollouts that have the honest result."""
    opening = run_terms_to_proto(RunTerms(GroupPolicy.PARTIAL, verified=True))
    opening.name, opening.run_id, opening.protocol_version = RUN, RUN, PROTOCOL_VERSION
    await manager.call("RolloutService/OpenRun", ADMIN, [opening.SerializeToString()])
    batch = rollout_service_pb2.ExecuteRequest(run_id=RUN, batch_id="honest-1")
    for number in range(ROLLOUTS):
        added = batch.rollouts.add()
        added.CopyFrom(rollouts[number % len(rollouts)])
        added.rollout_id, added.group_id = f"honest-{number}", f"g-{number}"
    stream = manager.open("RolloutService/Execute", ADMIN)
    stream.send(batch.SerializeToString())
    while not stream.task.done():
        for data in await stream.more():
            for message in rollout_service_pb2.ExecuteResponse.FromString(data).results:
                _count(played, rollout_result_from_proto(message))


def _count(played: Played, result: RolloutResult) -> None:
    match result.outcome:
        case Completed() as completed:
            is_right = completed.reward == prepared_result(()).reward
            played.right += is_right
            played.fabricated += not is_right
        case InfraFailure(InfraCode.RESULT_MISMATCH):
            played.disputed += 1
        case other:
            raise AssertionError(f"rollout {result.rollout_id} ended in {other}")


async def provoke(rng: random.Random, steps: int, workload: Workload, folder: Path) -> Played:
    """Play ``steps`` hostile steps. Raise AssertionError if the manager's state contradicts itself."""
    async with _entered(rng, workload, folder) as stage:
        for _step in range(steps):
            await stage.step()
        await stage.leave()
    return stage.played


@contextlib.asynccontextmanager
async def _entered(rng: random.Random, workload: Workload, folder: Path) -> AsyncIterator[_Stage]:
    """Start a manager with the scenes of the first rollouts, and connect the attackers."""
    played = Played()
    async with manager_inside(folder) as manager:
        played.tracebacks = manager.tracebacks
        stage = _Stage(manager, workload, rng, played)
        for digest in stage.digests:
            if not manager.runtime.bundles.has(digest):
                await manager.runtime.bundles.put(digest, _chunks(workload.bundles[digest]))
        await stage.enter()
        yield stage
        manager.runtime.cluster.check_invariants()


async def play(rng: random.Random, steps: int, workload: Workload, folder: Path) -> Played:
    """Play ``steps`` hostile steps beside an honest run, expel the attackers, and let the run finish.

    Raise AssertionError if the manager's state contradicts itself, or if an honest worker is expelled.
    """
    begins = rng.randrange(steps)
    async with _entered(rng, workload, folder) as stage, asyncio.TaskGroup() as group:
        manager = stage.manager
        workers = [
            group.create_task(_honest_worker(manager, f"honest-{number}", await stage.join(), stage.digests))
            for number in range(HONEST)
        ]
        for number in range(steps):
            if number == begins:
                run = group.create_task(_honest_run(manager, stage.rollouts, stage.played))
            await stage.step()
        await stage.leave()
        async with asyncio.timeout(FINISH_S):
            await run
        for worker in workers:
            worker.cancel()
    return stage.played


async def _chunks(data: bytes) -> AsyncIterator[bytes]:
    yield data


def play_seed(seed: int, steps: int, workload: Workload, folder: Path) -> Played:
    """Play the sequence that the seed gives."""
    return run_in_order(play(random.Random(seed), steps, workload, folder))


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m embomatrix.bench.adversary.sequences", description=__doc__
    )
    parser.add_argument("seed", type=int)
    parser.add_argument("steps", type=int, nargs="?", default=100)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as folder:
        played = play_seed(given.seed, given.steps, load_workload(PINNED), Path(folder))
    sys.stdout.write("".join(f"{number:4} {step}\n" for number, step in enumerate(played.steps, 1)))
    sys.stdout.write(
        f"{played.right} of {ROLLOUTS} honest rollouts are right, {played.disputed} disputed, {played.fabricated} fabricated; "
        f"statuses {dict(played.statuses)}\n"
    )
    sys.stdout.write("".join(played.tracebacks))
    return 1 if played.tracebacks or played.fabricated or played.outcomes != ROLLOUTS else 0


if __name__ == "__main__":
    sys.exit(main())
