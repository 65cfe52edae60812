"""Protocol versions that this release speaks, and the negotiation between two sides.

Messages only gain fields, so two versions differ in what each side may rely on. A release may speak a range of versions: a
cluster can then be upgraded one machine at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from embomatrix.rpc.status import PreconditionError

PROTOCOL_VERSION: Final = 2


@dataclass(frozen=True, slots=True)
class VersionRange:
    """Versions that a side speaks, both ends included."""

    oldest: int
    newest: int

    def __str__(self) -> str:
        return f"{self.newest}" if self.oldest == self.newest else f"{self.oldest} to {self.newest}"


_EXTRAS: Final = ("manager", "worker", "trainer")

SPOKEN: Final = VersionRange(PROTOCOL_VERSION, PROTOCOL_VERSION)


def agree(ours: VersionRange, theirs: VersionRange, *, us: str, them: str, their_release: str = "") -> int:
    """The newest version that both sides speak; PreconditionError, with the command that mends it, when there is none.

    ``us`` and ``them`` name the sides as its sentence does: ``this manager``, ``worker w1``. ``their_release`` is that of
    their software, if they told it.
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
    """Of the installed package; empty when it runs from a source tree that nobody installed."""
    try:
        return version("embomatrix")
    except PackageNotFoundError:
        return ""
