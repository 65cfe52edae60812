"""Typical times of the word-level policy on two cores, and the number of plans that a run evaluates. Imports no torch."""

from __future__ import annotations

from typing import Final

from embomatrix.trainer.config.settings import EvaluationSettings

IMITATION_STEP_S: Final = 0.6
GRPO_STEP_S: Final = 3.8
PLAN_S: Final = 0.02
"""Seconds of an imitation step, a GRPO step and an evaluated plan of the word-level policy on two cores.

Only their ratios matter once 5 % of a phase are done. Rounded from one run of the demo on two shared cores.
"""


def typical_seconds(imitation_steps: int, grpo_steps: int, plans: int) -> float:
    """Return the typical time of a run of the word-level policy on two cores."""
    return IMITATION_STEP_S * imitation_steps + GRPO_STEP_S * grpo_steps + PLAN_S * plans


def evaluations_during(settings: EvaluationSettings, steps: int, *, begun_at: int = 0) -> int:
    """Return the number of evaluations during GRPO from the step ``begun_at`` on. The last step has that after GRPO."""
    return max(0, (steps - 1) // settings.every - begun_at // settings.every) if settings.every else 0
