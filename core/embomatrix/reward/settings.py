"""Coefficients of the three tiers. The defaults are the paper's; a run may ask for others."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

LARGEST: Final = 1e6
"""Coefficients beyond this are taken for a mistake: rewards are compared to six decimal places."""


class RewardSettingsError(ValueError):
    """``field`` names the coefficient, ``problem`` what is wrong with it and what is expected."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field} {problem}")
        self.field = field
        self.problem = problem


@dataclass(frozen=True, slots=True)
class RewardSettings:
    """Constants of the three tiers; a tier of 0 is left out. Raises RewardSettingsError for what is no reward."""

    unparsable: float = -1.0
    """Whole reward of a text that is no plan."""
    format: float = 0.5
    """For a text that is a plan, whatever it does."""
    relevance_per_object: float = 0.2
    """For each object of the goal on which a skill call succeeded."""
    relevance_limit: float = 1.0
    goal: float = 30.0
    """For a goal whose atoms all hold; each atom earns its equal share."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and abs(value) <= LARGEST):
                raise RewardSettingsError(field.name, f"is {value:g}: expected a number between -1e6 and 1e6")
            if value < 0 and field.name != "unparsable":
                raise RewardSettingsError(
                    field.name, f"is {value:g}: a tier pays 0 or more, and 0 leaves it out"
                )
        if self.unparsable > self.format:
            raise RewardSettingsError(
                "unparsable",
                f"is {self.unparsable:g} and format {self.format:g}: "
                f"a text that is no plan may not be paid more than a plan, lower it",
            )


PAPER: Final = RewardSettings()
