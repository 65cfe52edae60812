"""Terms of the episodes of a run or an evaluation, of which the rules of each follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.envs.rules import EpisodeRules, Visibility
from embomatrix.skills.syntax import MAX_STEPS

if TYPE_CHECKING:
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.config.settings import EpisodeSettings


@dataclass(frozen=True, slots=True)
class EpisodeTerms:
    """Terms of all episodes. The budget of calls is a multiple of the oracle's, and some more."""

    visibility: Visibility
    calls_factor: float
    calls_more: int
    call_cost: float = 0.0
    failure_cost: float = 0.0
    answer_tokens: int = 64
    """Maximum tokens of a language model's answer."""
    step_weight: float = 0.0
    """Weight of step advantages in GRPO."""
    step_discount: float = 1.0

    @staticmethod
    def of(settings: EpisodeSettings) -> EpisodeTerms | None:
        """Terms of a run's episodes, None if the policy writes whole plans."""
        if settings.visibility is None:
            return None
        return EpisodeTerms(
            settings.visibility,
            settings.calls_factor,
            settings.calls_more,
            settings.call_cost,
            settings.failure_cost,
            settings.answer_tokens,
            settings.step_weight,
            settings.step_discount,
        )

    @property
    def sentence(self) -> str:
        """Sentence for a person: what the policy is told, and how many calls it may make."""
        told = "what the robot has seen" if self.sight else "all objects of the task"
        budget = f"{self.calls_factor:g} times the calls of the oracle plan and {self.calls_more} more, at most {MAX_STEPS}"
        return f"episodes: the policy is told of {told}, and may make {budget}"

    @property
    def sight(self) -> bool:
        """True if observations must say what the robot sees."""
        return self.visibility is Visibility.SEEN

    def rules(self, oracle: Plan) -> EpisodeRules:
        """Rules of an episode of a task with this oracle plan; without one, the budget is 64 calls."""
        most = int(self.calls_factor * len(oracle)) + self.calls_more if oracle else MAX_STEPS
        return EpisodeRules(
            self.visibility,
            calls=max(1, min(MAX_STEPS, most)),
            call_cost=self.call_cost,
            failure_cost=self.failure_cost,
        )
