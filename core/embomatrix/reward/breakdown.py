"""The three tiers of a rollout's reward, with what they were made of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AtomResult:
    """One scored sub-goal: its text, and whether it holds in the final state."""

    text: str
    holds: bool


@dataclass(frozen=True, slots=True)
class RewardBreakdown:
    """``total = format + relevance + goal``. ``success`` means that the whole formula holds."""

    format: float
    relevance: float
    goal: float
    atoms: tuple[AtomResult, ...]
    success: bool

    @property
    def total(self) -> float:
        return self.format + self.relevance + self.goal
