"""Residency decisions: the scenes to load and evict, from the wanted ones, the held ones and the memory."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

UNKNOWN_MB: Final = 60.0
"""Expected memory of a scene that was never loaded here."""


@dataclass(frozen=True, slots=True)
class HeldScene:
    """Scene that is held or being loaded. ``last_used`` grows with every use; busy scenes can't be evicted."""

    memory_mb: float
    last_used: int
    busy: bool


@dataclass(frozen=True, slots=True)
class Decision:
    """Scenes to evict, and then the scene to load; an empty ``load`` loads none."""

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
    """Return the next scene to load and the scenes to evict for it.

    ``wanted`` has the most urgent scene first. The first missing one is next, unless it is ``refused`` (its loading failed).
    Unwanted scenes are evicted first, the least recently used before others, then less urgent wanted ones. A scene is loaded
    over budget only if no other is held, because it could never execute otherwise.
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
    """Return the scenes to evict if the held ones exceed the budget; the most urgent one always stays."""
    used_mb = sum(scene.memory_mb for scene in held.values())
    evict: list[str] = []
    for victim in _victims(wanted, 0, held):
        if used_mb <= budget_mb or len(evict) + 1 >= len(held):
            break
        evict.append(victim)
        used_mb -= held[victim].memory_mb
    return tuple(evict)


def _victims(wanted: Sequence[str], place: int, held: Mapping[str, HeldScene]) -> list[str]:
    """Scenes that may be evicted for the one at ``place``, the least important first."""
    kept = set(wanted)
    unwanted = [digest for digest in held if digest not in kept and not held[digest].busy]
    unwanted.sort(key=lambda digest: held[digest].last_used)
    later = [digest for digest in wanted[place + 1 :] if digest in held and not held[digest].busy]
    return unwanted + later[::-1]
