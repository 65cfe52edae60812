"""Coefficients of the three reward tiers. The defaults are the paper's; a run may change them."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

LARGEST: Final = 1e6
"""Largest allowed coefficient: rewards are compared to six decimal places."""


class RewardSettingsError(ValueError):
    """Raised for an invalid coefficient. ``problem`` states the value found and the value expected."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem


@dataclass(frozen=True, slots=True)
class RewardSettings:
    """Coefficients of the reward. A coefficient of 0 disables its tier. Raises RewardSettingsError for an invalid one."""

    unparsable: float = -1.0
    """Total reward of a text that is not a plan."""
    format: float = 0.5
    """Reward of any text that is a plan."""
    relevance_per_object: float = 0.2
    """Reward for each goal object on which a skill call succeeded."""
    relevance_limit: float = 1.0
    goal: float = 30.0
    """Reward of a goal whose atoms all hold. Each atom earns an equal share."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and abs(value) <= LARGEST):
                raise RewardSettingsError(
                    field.name, f"found {value:g}: expected a number between -1e6 and 1e6"
                )
            if value < 0 and field.name != "unparsable":
                raise RewardSettingsError(
                    field.name, f"found {value:g}: expected 0 or more; 0 disables the tier"
                )
        if self.unparsable > self.format:
            raise RewardSettingsError(
                "unparsable",
                f"found {self.unparsable:g} with format {self.format:g}: "
                f"expected at most the reward of a plan; lower it",
            )


PAPER: Final = RewardSettings()
