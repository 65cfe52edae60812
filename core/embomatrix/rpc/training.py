"""How training goes, as a trainer tells the manager for people who watch: figures of a step, and some of its plans."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

FIGURES: Final = 64
"""Of one report, and of one phase."""
PLANS: Final = 8
"""Of one report."""
NAME_CHARS: Final = 64
"""Of a phase or a figure."""
TEXT_CHARS: Final = 4000
"""Of a plan or an instruction; what is longer is cut by who tells it."""
MESSAGE_CHARS: Final = 500


@dataclass(frozen=True, slots=True)
class SampledStep:
    """A skill call of a plan that was executed, and what became of it in words."""

    skill: str
    ok: bool
    message: str


@dataclass(frozen=True, slots=True)
class RewardTiers:
    """What a plan was given for its form, for touching what matters, and for reaching the goal."""

    format: float
    relevance: float
    goal: float
    success: bool


@dataclass(frozen=True, slots=True)
class SampledPlan:
    """A plan that a policy wrote. ``reward`` is None where the infrastructure lost the rollout.

    ``advantage`` is over its group, in standard deviations. ``problem`` says why there was nothing to execute, or why nothing
    came back.
    """

    task_id: str
    instruction: str
    text: str
    reward: RewardTiers | None
    advantage: float
    problem: str = ""
    steps: tuple[SampledStep, ...] = ()


@dataclass(frozen=True, slots=True)
class TrainingReport:
    """Of one step of a phase, ``grpo`` or ``imitation``. ``figures`` are by name; those of a table ``table/name``."""

    phase: str
    step: int
    figures: Mapping[str, float] = field(default_factory=dict)
    plans: tuple[SampledPlan, ...] = ()
