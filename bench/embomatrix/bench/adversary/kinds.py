"""Kinds of hostile messages by actor.

A strike is one attack: a few payloads that a kind makes from an attacker's knowledge.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)

SERVICES: Final = "embomatrix.proto.v1."
LEASES_KEPT: Final = 64


class AttackerRole(StrEnum):
    """Sender of hostile messages, by its token and its transport."""

    WORKER = "worker"
    """Holds a worker's own credential; its session stays open."""
    TRAINER = "trainer"
    """Holds a trainer's token."""
    STRANGER = "stranger"
    """Holds no token."""
    BROWSER = "browser"
    """Sends bytes to the HTTP port, with a trainer's token where it helps."""


@dataclass
class Knowledge:
    """Facts that an attacker has seen: its session, the leases that it got, scenes and plans, and its own run."""

    session_id: str = ""
    epoch: int = 0
    worker_id: str = ""
    run_id: str = ""
    token: str = ""
    host: str = ""
    rollouts: Sequence[types_pb2.Rollout] = ()
    leases: deque[worker_service_pb2.Lease] = field(default_factory=lambda: deque(maxlen=LEASES_KEPT))
    foreign: deque[worker_service_pb2.LeaseRef] = field(default_factory=lambda: deque(maxlen=LEASES_KEPT))
    """Leases of other workers, shared among colluding attackers."""
    batches: int = 0


Payload = Message | bytes
Make = Callable[[Knowledge, MessageMaker], Sequence[Payload]]


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of hostile message. ``method`` is SERVICE/CALL, empty for HTTP. ``weight`` is its share among its actor's."""

    name: str
    actor: AttackerRole
    method: str
    make: Make
    weight: float = 1.0


KINDS: Final[dict[str, Kind]] = {}
SLOW: Final = 0.02
"""Weight of kinds whose message has megabytes."""
LARGE_BYTES: Final = 24_000_000
UNKNOWN_BYTES: Final = 30_000


def hostile(name: str, actor: AttackerRole, method: str = "", weight: float = 1.0) -> Callable[[Make], Make]:
    """Decorator that enters a function as the kind ``name``. Raise ValueError if the name is taken."""

    def enter(make: Make) -> Make:
        if name in KINDS:
            raise ValueError(f"kind {name!r} exists twice: name each once")
        KINDS[name] = Kind(name, actor, method, make, weight)
        return make

    return enter


REQUESTS: Final[Mapping[str, type[Message]]] = {
    f"{service.full_name.removeprefix(SERVICES)}/{method.name}": GetMessageClass(method.input_type)
    for module in (admin_service_pb2, rollout_service_pb2, scene_service_pb2, worker_service_pb2)
    for service in module.DESCRIPTOR.services_by_name.values()
    for method in service.methods
}
"""Type of the request by SERVICE/CALL, of every call of the protocol."""


def _random(request: type[Message]) -> Make:
    return lambda _known, maker: [maker.any(request)]


def _garbled(request: type[Message]) -> Make:
    return lambda _known, maker: [maker.garbled(maker.any(request))]


def _enter_every_method() -> None:
    """Enter a random message and a garbled one of every call, by each actor that has a reason to send it."""
    for method, request in REQUESTS.items():
        call = method.split("/")[1]
        actor = AttackerRole.WORKER if method.startswith("WorkerService") else AttackerRole.TRAINER
        hostile(f"any {call}", actor, method)(_random(request))
        hostile(f"garbled {call}", actor, method)(_garbled(request))
        hostile(f"{call} without a token", AttackerRole.STRANGER, method)(_random(request))


_enter_every_method()


@hostile("24 MB without a token", AttackerRole.STRANGER, "RolloutService/CancelBatch", SLOW)
def _large_call(_known: Knowledge, maker: MessageMaker) -> Sequence[Payload]:
    return [maker.rng.randbytes(LARGE_BYTES)]


def unknown_field(maker: MessageMaker) -> bytes:
    """Return a field of 30 kB that no version of the protocol defines; parsed messages keep it."""
    text = maker.rng.randbytes(UNKNOWN_BYTES)
    # Number 127, length-delimited, and the length in three groups of seven bits.
    length = (UNKNOWN_BYTES & 0x7F | 0x80, UNKNOWN_BYTES >> 7 & 0x7F | 0x80, UNKNOWN_BYTES >> 14)
    return bytes((0xFA, 0x07, *length)) + text
