"""When a worker pauses and when it goes on: decided from what was seen and what the owner wishes, without looking or acting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.worker.host.preferences import Hours

if TYPE_CHECKING:
    from embomatrix.worker.host.preferences import Preferences

LOADED_S: Final = 10.0
"""Others must keep the machine this busy for as long before it counts: starting a program is no reason to pause."""
CALM_SHARE: Final = 0.75
"""A pause for load ends below this share of the limit: what hovers about the limit must not switch the worker on and off."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What the machine shows. None: it can't be seen here, and speaks against nothing."""

    minute: int
    """Of the local day."""
    owner_idle_s: float | None = None
    """Since the last sign of a person."""
    on_mains: bool | None = None
    others_load: float | None = None
    """Share of all cores that programs use which are not ours, 0 to 1."""
    free_memory: float = 1.0
    """Share of the memory that is available, 0 to 1."""


@dataclass(frozen=True, slots=True)
class PauseState:
    """Whether a worker is paused: ``reason`` is empty while it works. Times are seconds of one monotonic clock."""

    reason: str = ""
    since_s: float = 0.0
    """When the pause began."""
    calm_since_s: float | None = None
    """While paused: since when nothing has spoken against work."""
    loaded_since_s: float | None = None
    """Since when others have kept the machine busier than the limit."""


WORKING: Final = PauseState()


def judge(before: PauseState, seen: Observation, wishes: Preferences, now_s: float) -> PauseState:
    """The standing after this observation.

    A pause begins at once, for load after ``LOADED_S`` of it, and ends when nothing has spoken against work for ``calm_s``.
    """
    loaded_since_s = _loaded_since_s(before, seen, wishes, now_s)
    reason = _objection(before, seen, wishes, loaded_since_s, now_s)
    if not before.reason:
        return PauseState(reason, now_s if reason else 0.0, None, loaded_since_s)
    if reason:
        return replace(before, reason=reason, calm_since_s=None, loaded_since_s=loaded_since_s)
    calm_since_s = now_s if before.calm_since_s is None else before.calm_since_s
    if now_s - calm_since_s >= wishes.calm_s:
        return WORKING
    return replace(before, calm_since_s=calm_since_s, loaded_since_s=loaded_since_s)


def _loaded_since_s(before: PauseState, seen: Observation, wishes: Preferences, now_s: float) -> float | None:
    if not wishes.max_load or seen.others_load is None or seen.others_load <= wishes.max_load:
        return None
    return now_s if before.loaded_since_s is None else before.loaded_since_s


def _objection(
    before: PauseState, seen: Observation, wishes: Preferences, loaded_since_s: float | None, now_s: float
) -> str:
    """What speaks against work, in words; empty when nothing does."""
    if wishes.hours and not Hours.parse(wishes.hours).has(seen.minute):
        return f"outside of its hours {wishes.hours}"
    if wishes.mains_only and seen.on_mains is False:
        return "on battery"
    if wishes.idle_s and seen.owner_idle_s is not None and seen.owner_idle_s < wishes.idle_s:
        return "its owner is active"
    if not wishes.max_load or seen.others_load is None:
        return ""
    limit = wishes.max_load * (CALM_SHARE if before.reason else 1.0)
    lasting = loaded_since_s is not None and now_s - loaded_since_s >= LOADED_S
    if seen.others_load > limit and (before.reason or lasting):
        return f"other programs use more than {wishes.max_load:.0%} of the cores"
    return ""
