"""Rules of an episode: what a policy is told, and when the episode ends."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, TypeVar

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.skills.syntax import MAX_STEPS

EQUAL_FAILURES: Final = 4


E = TypeVar("E", bound=StrEnum)


def member(kind: type[E], name: str, value: str) -> E:
    """Return the member of an enumeration. Raises ValueError with all members for another word."""
    try:
        return kind(value)
    except ValueError:
        raise ValueError(f"{name} is {value!r}: expected one of {', '.join(kind)}") from None


class Visibility(StrEnum):
    """Part of the world that observations tell of."""

    FULL = "full"
    """All rows of the task's table, from the start."""
    SEEN = "seen"
    """Rows that the robot has seen. A call with another row fails as one with a row that does not exist."""


class EpisodeEnd(StrEnum):
    """Reason why an episode is over."""

    DONE = "done"
    """The policy said so."""
    GOAL = "goal"
    """The goal is reached, and the rules end an episode there."""
    CALLS = "calls"
    """The budget of calls is used up."""
    LOOP = "loop"
    """The same call failed time after time."""
    TOKENS = "tokens"
    """The policy has no room for another answer."""


@dataclass(frozen=True, slots=True)
class EpisodeRules:
    """Rules of an episode.

    Answers that are no call, and calls with unknown rows, count as failed calls. Raises ValueError for a number out of range.
    """

    visibility: Visibility = Visibility.FULL
    calls: int = MAX_STEPS
    """Budget of calls, 1 to 64."""
    calls_per_answer: int = 1
    """Calls of one answer that are executed, up to the first failure. The others are left out, and the observation says so."""
    ends_at_goal: bool = False
    """End the episode once the goal is reached. Otherwise the policy says when it is done."""
    equal_failures: int = EQUAL_FAILURES
    """End the episode when the same call fails this many times in a row; 0 for never."""
    call_cost: float = 0.0
    """Subtracted from the episode's reward for each call."""
    failure_cost: float = 0.0
    """Subtracted from the episode's reward for each failed call, besides ``call_cost``."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "visibility", member(Visibility, "visibility", self.visibility))
        for name, low, high in (
            ("calls", 1, MAX_STEPS),
            ("calls_per_answer", 1, MAX_STEPS),
            ("equal_failures", 0, MAX_STEPS),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name} is {value!r}: expected a whole number from {low} to {high}")
        for name in ("call_cost", "failure_cost"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0.0 <= value < float("inf"):
                raise ValueError(f"{name} is {value!r}: expected 0 or a positive number")


def rules_of(rules: EpisodeRules | None, visibility: str | None) -> EpisodeRules:
    """Return the rules, by default the usual ones; a given visibility counts more than theirs. Raises ValueError."""
    known = EpisodeRules() if rules is None else rules
    if visibility is None:
        return known
    return replace(known, visibility=member(Visibility, "visibility", visibility))


@dataclass(frozen=True, slots=True)
class EpisodeReward:
    """Reward of an episode: the tiers of the state reached, less the costs of its calls."""

    tiers: RewardBreakdown
    calls: int = 0
    """Calls so far, failed ones included."""
    failures: int = 0
    cost: float = 0.0

    @property
    def total(self) -> float:
        return self.tiers.total - self.cost

    @property
    def metrics(self) -> dict[str, float]:
        """Success and counts of calls as numbers, for the logs of other libraries."""
        return {
            "success": float(self.tiers.success),
            "calls": float(self.calls),
            "failed_calls": float(self.failures),
        }
