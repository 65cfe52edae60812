"""Attackers that send strikes of random kinds to a manager, and count their messages and the answers."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import grpc

# The modules of kinds enter their kinds on import.
from embomatrix.bench.adversary import browser_kinds as _browser_kinds
from embomatrix.bench.adversary import trainer_kinds as _trainer_kinds
from embomatrix.bench.adversary.kinds import KINDS, SERVICES, AttackerRole, Kind, Knowledge, Payload
from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.bench.adversary.worker_kinds import SESSION, first_state, lie, sound_registration
from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.rpc.channel import TOKEN_KEY, bearer, open_channel
from embomatrix.rpc.status import ERROR_KEY
from embomatrix.rpc.versions import PROTOCOL_VERSION

__all__ = ["Fight", "Target", "browser", "fast_liar", "hostile_worker", "stranger", "trainer"]
_ = (_browser_kinds, _trainer_kinds)

ANSWER_S: Final = 0.5
"""Time for the answer to one strike; a stream without an end is cancelled then."""
REGISTER_S: Final = 10.0
HTTP_S: Final = 0.5
CALLS_AT_ONCE: Final = 8
STRIKES_PER_SESSION: Final = 40
"""Messages in one session, unless the manager ends it earlier. A new stream begins with a full state and its claims."""
SOUND_START: Final = 0.7
"""Share of streams that begin with a sound state. The others begin with any message."""
UNREACHABLE_S: Final = 0.05
REST_S: Final = 0.001
"""Pause after a message in a session, so that its answer can be read."""


@dataclass(frozen=True, slots=True)
class Target:
    """Manager under attack. ``join`` returns a fresh token that registers one worker."""

    address: str
    http: str
    """HOST:PORT of the dashboard."""
    trainer_token: str
    rollouts: Sequence[types_pb2.Rollout]
    join: Callable[[], Awaitable[str]]


@dataclass
class Fight:
    """Messages by kind, and answers by status. The attackers stop once ``most`` messages were sent."""

    most: int
    sent: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    internal: Counter[str] = field(default_factory=Counter)
    """Answers INTERNAL by kind, except those to bytes that are no message."""

    @property
    def over(self) -> bool:
        return self.sent.total() >= self.most

    def answered(self, kind: Kind, error: grpc.aio.AioRpcError) -> None:
        code = error.code()
        self.answers[code.name] += 1
        if code is grpc.StatusCode.INTERNAL and ERROR_KEY in dict(error.trailing_metadata() or ()):
            self.internal[kind.name] += 1


def _bytes(payload: Payload) -> bytes:
    return payload if isinstance(payload, bytes) else payload.SerializeToString()


class Arsenal:
    """Kinds of one actor, drawn by weight. ``every`` visits each kind once before the first draw."""

    def __init__(self, rng: random.Random, actor: AttackerRole, *, calls_only: bool = False) -> None:
        found = [kind for kind in KINDS.values() if kind.actor is actor]
        self._kinds = [kind for kind in found if not (calls_only and kind.method == SESSION)]
        self._weights = [kind.weight for kind in self._kinds]
        self._first = deque(rng.sample(self._kinds, len(self._kinds)))
        self._rng = rng

    def draw(self) -> Kind:
        return self._first.popleft() if self._first else self._rng.choices(self._kinds, self._weights)[0]


def _metadata(token: str) -> tuple[tuple[str, str], ...]:
    return ((TOKEN_KEY, bearer(token)),) if token else ()


def _opened(
    channel: grpc.aio.Channel, method: str, token: str, limit_s: float | None = None
) -> grpc.aio.StreamStreamCall[bytes, bytes]:
    """Return a call of any shape. On the wire a single request is a stream of one."""
    open_call = channel.stream_stream(f"/{SERVICES}{method}")
    return open_call(timeout=limit_s, metadata=_metadata(token))


async def _call(
    channel: grpc.aio.Channel, token: str, kind: Kind, payloads: Sequence[bytes], fight: Fight
) -> None:
    """Send the payloads as one call of any shape and read its answers for at most ``ANSWER_S`` seconds."""
    fight.sent[kind.name] += len(payloads)
    call = _opened(channel, kind.method, token, ANSWER_S)
    try:
        for payload in payloads:
            await call.write(payload)
        await call.done_writing()
        while await call.read() is not grpc.aio.EOF:
            pass
        fight.answers["OK"] += 1
    except grpc.aio.AioRpcError as error:
        fight.answered(kind, error)
        if error.code() is grpc.StatusCode.UNAVAILABLE:
            await asyncio.sleep(UNREACHABLE_S)
    except asyncio.InvalidStateError:  # the manager answered before it had read everything
        fight.answers[(await call.code()).name] += 1
    finally:
        call.cancel()


async def _strike_in_parallel(
    channel: grpc.aio.Channel, arsenal: Arsenal, known: Knowledge, maker: MessageMaker, fight: Fight
) -> None:
    async def strikes() -> None:
        while not fight.over:
            kind = arsenal.draw()
            payloads = [_bytes(payload) for payload in kind.make(known, maker)]
            await _call(channel, known.token, kind, payloads, fight)

    async with asyncio.TaskGroup() as group:
        for _ in range(CALLS_AT_ONCE):
            group.create_task(strikes())


async def stranger(target: Target, fight: Fight, seed: int) -> None:
    """Send every call without a token."""
    rng = random.Random(seed)
    maker = MessageMaker(rng)
    known = Knowledge(rollouts=target.rollouts)
    async with open_channel(target.address) as channel:
        await _strike_in_parallel(channel, Arsenal(rng, AttackerRole.STRANGER), known, maker, fight)


async def trainer(target: Target, fight: Fight, seed: int) -> None:
    """Send batches, runs, bundles and every other call with a trainer's token."""
    rng = random.Random(seed)
    known = Knowledge(run_id=f"hostile-{seed}", rollouts=target.rollouts, token=target.trainer_token)
    maker = MessageMaker(rng, [known.run_id, *{rollout.bundle_digest for rollout in target.rollouts}])
    async with open_channel(target.address) as channel:
        opening = rollout_service_pb2.OpenRunRequest(
            name="hostile", run_id=known.run_id, protocol_version=PROTOCOL_VERSION
        )
        kind = KINDS["any OpenRun"]
        await _call(channel, known.token, kind, [opening.SerializeToString()], fight)
        await _strike_in_parallel(channel, Arsenal(rng, AttackerRole.TRAINER), known, maker, fight)


async def browser(target: Target, fight: Fight, seed: int) -> None:
    """Send bytes to the HTTP port, one connection each."""
    rng = random.Random(seed)
    known = Knowledge(token=target.trainer_token, host=target.http)
    maker, arsenal = MessageMaker(rng), Arsenal(rng, AttackerRole.BROWSER)
    host, _, port = target.http.rpartition(":")
    while not fight.over:
        kind = arsenal.draw()
        (data,) = (_bytes(payload) for payload in kind.make(known, maker))
        fight.sent[kind.name] += 1
        with contextlib.suppress(OSError, TimeoutError):
            fight.answers[await _http(host, int(port), data)] += 1


async def _http(host: str, port: int, data: bytes) -> str:
    """Return the status in the first line of the answer, as ``HTTP 401``."""
    async with asyncio.timeout(HTTP_S):
        reader, writer = await asyncio.open_connection(host, port)
        try:
            writer.write(data)
            await writer.drain()
            words = (await reader.readline()).split()
        finally:
            writer.close()
    return f"HTTP {words[1].decode('ascii', 'replace')}" if len(words) > 1 else "HTTP closed"


async def hostile_worker(
    target: Target, fight: Fight, seed: int, foreign: deque[pb.LeaseRef] | None = None
) -> None:
    """Register, hold scenes, and send any messages; register again after each end of the session.

    ``foreign`` collects the leases of all workers that share it. A worker that is refused takes a new name with a new token,
    since an attacker with many tokens does more harm than one quarantined worker.
    """
    rng = random.Random(seed)
    shared = deque(maxlen=64) if foreign is None else foreign
    arsenal = Arsenal(rng, AttackerRole.WORKER)
    lives = 0
    while not fight.over:
        lives += 1
        known = Knowledge(worker_id=f"foe-{seed}-{lives}", rollouts=target.rollouts, foreign=shared)
        known.run_id = "siege"
        join_token = await target.join()
        with contextlib.suppress(grpc.aio.AioRpcError):
            async with open_channel(target.address) as channel:
                answer = await _register(channel, "", sound_registration(known, join_token))
                known.token = answer.credential
                while not fight.over:
                    known.session_id, known.epoch = answer.session_id, answer.session_epoch
                    known.leases.clear()
                    await _fight_in_session(channel, known, arsenal, rng, fight)
                    answer = await _register(channel, known.token, sound_registration(known))
        await asyncio.sleep(UNREACHABLE_S)


async def _register(
    channel: grpc.aio.Channel, token: str, request: pb.RegisterRequest
) -> pb.RegisterResponse:
    call = channel.unary_unary(f"/{SERVICES}WorkerService/Register")
    sent = call(request.SerializeToString(), timeout=REGISTER_S, metadata=_metadata(token))
    return pb.RegisterResponse.FromString(await sent)


async def _fight_in_session(
    channel: grpc.aio.Channel, known: Knowledge, arsenal: Arsenal, rng: random.Random, fight: Fight
) -> None:
    """Send strikes in one session until the manager ends it, or ``STRIKES_PER_SESSION`` were sent."""
    maker = MessageMaker(rng, [known.session_id, known.worker_id, known.run_id])
    stream = _opened(channel, SESSION, known.token)
    kind = KINDS["any Session"]
    listening = asyncio.create_task(_collect_leases(stream, known, maker))
    try:
        if rng.random() < SOUND_START:
            await stream.write(first_state(known).SerializeToString())
        for _ in range(STRIKES_PER_SESSION):
            if fight.over or listening.done():
                return
            kind = arsenal.draw()
            payloads = [_bytes(payload) for payload in kind.make(known, maker)]
            if kind.method != SESSION:
                await _call(channel, known.token, kind, payloads, fight)
                continue
            for payload in payloads:
                fight.sent[kind.name] += 1
                await stream.write(payload)
            await asyncio.sleep(REST_S)
    except asyncio.InvalidStateError:
        pass  # the manager has ended the session
    except grpc.aio.AioRpcError as error:
        fight.answered(kind, error)
    finally:
        stream.cancel()
        listening.cancel()
        ended = (await asyncio.gather(listening, return_exceptions=True))[0]
        if isinstance(ended, grpc.aio.AioRpcError):
            fight.answered(kind, ended)


async def _collect_leases(
    stream: grpc.aio.StreamStreamCall[bytes, bytes], known: Knowledge, maker: MessageMaker
) -> None:
    while (data := await stream.read()) is not grpc.aio.EOF:
        for lease in pb.SessionResponse.FromString(data).leases:
            known.leases.append(lease)
            known.foreign.append(lease.ref)
            maker.known.append(lease.ref.lease_id)
    del maker.known[:-64]


async def fast_liar(target: Target, name: str = "liar") -> None:
    """Answer every lease at once with a well-formed made-up result, until cancelled or expelled."""
    known = Knowledge(worker_id=name, rollouts=target.rollouts)
    async with open_channel(target.address) as channel:
        answer = await _register(channel, "", sound_registration(known, await target.join()))
    known.session_id, known.epoch = answer.session_id, answer.session_epoch
    async with open_channel(target.address) as channel:
        stream = _opened(channel, SESSION, answer.credential)
        with contextlib.suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):
            await stream.write(first_state(known).SerializeToString())
            while (data := await stream.read()) is not grpc.aio.EOF:
                leases = pb.SessionResponse.FromString(data).leases
                if leases:
                    lies = pb.SessionRequest(
                        session_id=known.session_id,
                        session_epoch=known.epoch,
                        results=[lie(lease) for lease in leases],
                    )
                    await stream.write(lies.SerializeToString())
