"""Which scenes a worker loads and evicts: decided from what is wanted, what is held and the memory there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

UNKNOWN_MB: Final = 60.0
"""Memory that a scene is expected to take before it was ever loaded here."""


@dataclass(frozen=True, slots=True)
class HeldScene:
    """A scene that is held or being loaded. ``last_used`` grows with every use; ``busy`` ones can't be evicted."""

    memory_mb: float
    last_used: int
    busy: bool


@dataclass(frozen=True, slots=True)
class Decision:
    """Evict these, then load that one. Nothing to load: ``load`` is empty."""

    load: str = ""
    evict: tuple[str, ...] = ()


NOTHING: Final = Decision()


def decide(
    wanted: Sequence[str],
    held: Mapping[str, HeldScene],
    *,
    budget_mb: float,
    known_mb: Mapping[str, float],
    refused: Collection[str] = (),
) -> Decision:
    """The next scene to load and what must go for it.

    ``wanted`` has the most urgent first; the first that is missing is next, unless it is ``refused`` (its loading failed).
    Scenes that nobody wants make room first, the longest unused before others, then wanted ones that are less urgent.
    A scene is loaded over budget only when nothing else is held: it could never be executed otherwise.
    """
    used_mb = sum(scene.memory_mb for scene in held.values())
    for place, digest in enumerate(wanted):
        if digest in held or digest in refused:
            continue
        need_mb = known_mb.get(digest, UNKNOWN_MB)
        evict: list[str] = []
        for victim in _victims(wanted, place, held):
            if used_mb + need_mb <= budget_mb:
                break
            evict.append(victim)
            used_mb -= held[victim].memory_mb
        if used_mb + need_mb <= budget_mb or len(evict) == len(held):
            return Decision(digest, tuple(evict))
        return NOTHING
    return NOTHING


def surplus(wanted: Sequence[str], held: Mapping[str, HeldScene], *, budget_mb: float) -> tuple[str, ...]:
    """What to evict because the scenes held turned out larger than the budget; the most urgent one always stays."""
    used_mb = sum(scene.memory_mb for scene in held.values())
    evict: list[str] = []
    for victim in _victims(wanted, 0, held):
        if used_mb <= budget_mb or len(evict) + 1 >= len(held):
            break
        evict.append(victim)
        used_mb -= held[victim].memory_mb
    return tuple(evict)


def _victims(wanted: Sequence[str], place: int, held: Mapping[str, HeldScene]) -> list[str]:
    """Scenes that may go for the one at ``place``, the most dispensable first."""
    kept = set(wanted)
    unwanted = [digest for digest in held if digest not in kept and not held[digest].busy]
    unwanted.sort(key=lambda digest: held[digest].last_used)
    later = [digest for digest in wanted[place + 1 :] if digest in held and not held[digest].busy]
    return unwanted + later[::-1]
