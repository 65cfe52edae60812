"""Three tiers of a rollout's reward and the atoms behind them."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AtomResult:
    """One scored sub-goal: its text, and its truth in the final state."""

    text: str
    holds: bool


@dataclass(frozen=True, slots=True)
class RewardBreakdown:
    """Reward of one rollout: ``total = format + relevance + goal``. ``success``: the whole goal formula holds."""

    format: float
    relevance: float
    goal: float
    atoms: tuple[AtomResult, ...]
    success: bool

    @property
    def total(self) -> float:
        return self.format + self.relevance + self.goal

    @property
    def tiers(self) -> dict[str, float]:
        """The summands of the total by name."""
        return {"format": self.format, "relevance": self.relevance, "goal": self.goal}
