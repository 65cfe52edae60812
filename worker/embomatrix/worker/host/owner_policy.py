"""Policy of a spare PC's owner: preferences of when its worker may work, and the decision to pause or resume.

Decisions are pure: they take an observation, the preferences and the time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

from pydantic import BaseModel, ConfigDict, Field, field_validator

DAY_MINUTES: Final = 24 * 60
LOADED_S: Final = 10.0
"""Others must keep the machine busy this long before a pause: starting a program is no reason."""
CALM_SHARE: Final = 0.75
"""A pause for load ends below this share of the limit, which keeps a load near the limit from toggling the worker."""
_HOURS: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)-([01]?\d|2[0-3]):([0-5]\d)")


@dataclass(frozen=True, slots=True)
class Hours:
    """Part of every day in minutes of the local day, without its end. It may span midnight."""

    begin: int
    end: int

    @staticmethod
    def parse(text: str) -> Hours:
        """Parse ``18:00-08:00``. Raise ValueError for any other form and for an empty part."""
        found = _HOURS.fullmatch(text)
        if found is None:
            raise ValueError("expected HH:MM-HH:MM, as in 18:00-08:00")
        first_h, first_m, last_h, last_m = map(int, found.groups())
        hours = Hours(first_h * 60 + first_m, last_h * 60 + last_m)
        if hours.begin == hours.end:
            raise ValueError("the interval is empty: leave the option out to work all day")
        return hours

    def has(self, minute: int) -> bool:
        """Return whether the minute of the day, 0 to 1439, is included."""
        return (minute - self.begin) % DAY_MINUTES < (self.end - self.begin) % DAY_MINUTES


class Preferences(BaseModel):
    """Times at which a worker works: always by default. Each preference can pause it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    hours: str = ""
    """Local working hours, ``18:00-08:00``; empty: all day."""
    idle_s: float = Field(0.0, ge=0, allow_inf_nan=False)
    """Seconds without a sign of the owner before work begins. 0: the owner is ignored."""
    mains_only: bool = False
    """Pause on battery."""
    max_load: float = Field(0.0, ge=0, le=1)
    """Share of the machine's cores that other programs may use before the worker pauses. 0: they are ignored."""
    grace_s: float = Field(10.0, ge=0, allow_inf_nan=False)
    """Time for running rollouts to end after a pause began; then they are handed back."""
    calm_s: float = Field(30.0, ge=0, allow_inf_nan=False)
    """Work resumes after this time without a reason to pause."""
    check_s: float = Field(2.0, gt=0, allow_inf_nan=False)
    """Seconds between two observations of the machine."""

    @field_validator("hours")
    @classmethod
    def _check_hours(cls, value: str) -> str:
        if value:
            Hours.parse(value)
        return value

    @property
    def always(self) -> bool:
        """True if no observation could pause the worker."""
        return not (self.hours or self.idle_s or self.mains_only or self.max_load)


@dataclass(frozen=True, slots=True)
class Observation:
    """State of the machine. None: the value is unknown here and is no reason to pause."""

    minute: int
    """Minute of the local day."""
    owner_idle_s: float | None = None
    """Seconds since the last sign of a user."""
    on_mains: bool | None = None
    others_load: float | None = None
    """Share of all cores that other programs use, 0 to 1."""
    free_memory: float = 1.0
    """Share of the memory that is available, 0 to 1."""


@dataclass(frozen=True, slots=True)
class PauseState:
    """Pause of a worker: ``reason`` is empty while it works. Times are seconds of one monotonic clock."""

    reason: str = ""
    since_s: float = 0.0
    """Beginning of the pause."""
    calm_since_s: float | None = None
    """While paused: beginning of the time without a reason to pause."""
    loaded_since_s: float | None = None
    """Beginning of the time in which others used more than the limit."""


WORKING: Final = PauseState()


def next_pause_state(
    before: PauseState, seen: Observation, preferences: Preferences, now_s: float
) -> PauseState:
    """Return the state after this observation.

    A pause begins at once, for load after ``LOADED_S`` of it. It ends after ``calm_s`` without a reason to pause.
    """
    loaded_since_s = _loaded_since_s(before, seen, preferences, now_s)
    reason = _pause_reason(before, seen, preferences, loaded_since_s, now_s)
    if not before.reason:
        return PauseState(reason, now_s if reason else 0.0, None, loaded_since_s)
    if reason:
        return replace(before, reason=reason, calm_since_s=None, loaded_since_s=loaded_since_s)
    calm_since_s = now_s if before.calm_since_s is None else before.calm_since_s
    if now_s - calm_since_s >= preferences.calm_s:
        return WORKING
    return replace(before, calm_since_s=calm_since_s, loaded_since_s=loaded_since_s)


def _loaded_since_s(
    before: PauseState, seen: Observation, preferences: Preferences, now_s: float
) -> float | None:
    limit = preferences.max_load
    if not limit or seen.others_load is None or seen.others_load <= limit:
        return None
    return now_s if before.loaded_since_s is None else before.loaded_since_s


def _pause_reason(
    before: PauseState,
    seen: Observation,
    preferences: Preferences,
    loaded_since_s: float | None,
    now_s: float,
) -> str:
    """Reason to pause now; empty if there is none."""
    if preferences.hours and not Hours.parse(preferences.hours).has(seen.minute):
        return f"outside of its hours {preferences.hours}"
    if preferences.mains_only and seen.on_mains is False:
        return "on battery"
    if preferences.idle_s and seen.owner_idle_s is not None and seen.owner_idle_s < preferences.idle_s:
        return "its owner is active"
    if not preferences.max_load or seen.others_load is None:
        return ""
    limit = preferences.max_load * (CALM_SHARE if before.reason else 1.0)
    lasting = loaded_since_s is not None and now_s - loaded_since_s >= LOADED_S
    if seen.others_load > limit and (before.reason or lasting):
        return f"other programs use more than {preferences.max_load:.0%} of the cores"
    return ""
