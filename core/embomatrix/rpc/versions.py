"""Protocol versions that this release speaks, and the negotiation between two sides.

Messages only gain fields, so two versions differ in what each side may rely on. A release may speak a range of versions: a
cluster can then be upgraded one machine at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.status import PreconditionError

if TYPE_CHECKING:
    from embomatrix.proto.v1.rollout_service_pb2_grpc import RolloutServiceAsyncStub

PROTOCOL_VERSION: Final = 3
"""Newest version."""
OLDEST_VERSION: Final = 2
MERGING_VERSION: Final = 3
"""First version in which a rollout can name the ids of equal ones."""


@dataclass(frozen=True, slots=True)
class VersionRange:
    """Range of protocol versions, both ends included."""

    oldest: int
    newest: int

    def __str__(self) -> str:
        return f"{self.newest}" if self.oldest == self.newest else f"{self.oldest} to {self.newest}"


_EXTRAS: Final = ("manager", "worker", "trainer")

SPOKEN: Final = VersionRange(OLDEST_VERSION, PROTOCOL_VERSION)


def agree(ours: VersionRange, theirs: VersionRange, *, us: str, them: str, their_release: str = "") -> int:
    """Return the newest version that both sides speak. Raise PreconditionError with an upgrade command if there is none.

    ``us`` and ``them`` name the two sides in the message, as in ``this manager`` and ``worker w1``. ``their_release`` is the
    software release of the other side, if known.
    """
    agreed = min(ours.newest, theirs.newest)
    if agreed >= max(ours.oldest, theirs.oldest):
        return agreed
    they_are_behind = theirs.newest < ours.oldest
    behind, release = (them, software_version()) if they_are_behind else (us, their_release)
    extra = next(word for word in behind.split() if word in _EXTRAS)
    pinned = f"=={release}" if release else ""
    raise PreconditionError(
        f"{them} speaks protocol {theirs}, {us} {ours}: upgrade {behind} with "
        f"`pip install --upgrade 'embomatrix[{extra}]{pinned}'`"
    )


def software_version() -> str:
    """Return the version of the installed package; empty in a source tree that is not installed."""
    try:
        return version("embomatrix")
    except PackageNotFoundError:
        return ""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Versions, limits and certificate authority of a manager."""

    protocol: VersionRange
    release: str = ""
    batch_rollouts: int = 0
    bundle_bytes: int = 0
    ca_certificate: str = ""
    """PEM; empty without TLS."""


async def capabilities_of(stub: RolloutServiceAsyncStub, *, timeout_s: float) -> Capabilities:
    """Ask the manager behind the stub. Raises AioRpcError."""
    answer = await stub.GetCapabilities(pb.GetCapabilitiesRequest(), timeout=timeout_s)
    return Capabilities(
        VersionRange(answer.protocol_low, answer.protocol_high),
        answer.version,
        answer.batch_rollouts,
        answer.bundle_bytes,
        answer.ca_certificate,
    )
