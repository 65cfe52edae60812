"""What the owner of a spare PC wishes: when its worker may work. Parsed once, at the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from pydantic import BaseModel, ConfigDict, Field, field_validator

DAY_MINUTES: Final = 24 * 60
_HOURS: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)-([01]?\d|2[0-3]):([0-5]\d)")


@dataclass(frozen=True, slots=True)
class Hours:
    """A part of every day, in minutes of the local day; it may reach over midnight. Its end is not part of it."""

    begin: int
    end: int

    @staticmethod
    def parse(text: str) -> Hours:
        """``18:00-08:00``. Raises ValueError for anything else, and for a part that is empty."""
        found = _HOURS.fullmatch(text)
        if found is None:
            raise ValueError("expected HH:MM-HH:MM, as in 18:00-08:00")
        first_h, first_m, last_h, last_m = map(int, found.groups())
        hours = Hours(first_h * 60 + first_m, last_h * 60 + last_m)
        if hours.begin == hours.end:
            raise ValueError("begins when it ends: leave it out to work all day")
        return hours

    def has(self, minute: int) -> bool:
        """Whether the minute of the day, 0 to 1439, is part of it."""
        return (minute - self.begin) % DAY_MINUTES < (self.end - self.begin) % DAY_MINUTES


class Preferences(BaseModel):
    """When a worker works. By default always; each wish that is set can pause it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hours: str = ""
    """Local time of the day to work in, ``18:00-08:00``; empty: all day."""
    idle_s: float = Field(0.0, ge=0, allow_inf_nan=False)
    """Seconds without a sign of the owner before work begins. 0: the owner doesn't mind."""
    mains_only: bool = False
    """Pause on battery."""
    max_load: float = Field(0.0, ge=0, le=1)
    """Share of the machine's cores that other programs may use before the worker pauses. 0: they don't matter."""
    grace_s: float = Field(10.0, ge=0, allow_inf_nan=False)
    """How long running rollouts may take to end after a pause began; then they are given back."""
    calm_s: float = Field(30.0, ge=0, allow_inf_nan=False)
    """Work goes on when nothing has spoken against it for so long."""
    check_s: float = Field(2.0, gt=0, allow_inf_nan=False)
    """Seconds between two looks at the machine."""

    @field_validator("hours")
    @classmethod
    def _check_hours(cls, value: str) -> str:
        if value:
            Hours.parse(value)
        return value

    @property
    def indifferent(self) -> bool:
        """Nothing that could be seen would pause the worker."""
        return not (self.hours or self.idle_s or self.mains_only or self.max_load)
