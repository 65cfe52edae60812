"""Phases of a run with their typical times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.trainer.config.typical_times import (
    GRPO_STEP_S,
    IMITATION_STEP_S,
    PLAN_S,
    evaluations_during,
)
from embomatrix.trainer.logging.evaluations import AFTER, BEFORE, DURING
from embomatrix.trainer.logging.run_clock import Phase, PhaseTime, RunClock
from embomatrix.trainer.policy.loading import is_word_level

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.run.starting import RunStart


def clock_of(start: RunStart, *, began_s: float, warn_after_s: float | None = None) -> RunClock:
    """Return the clock of a run with imitation, evaluations and GRPO.

    With a budget of minutes the number of evaluations during GRPO is unknown, and they are left out.
    """
    settings, progress = start.settings, start.progress
    typical = _is_typical(settings)
    grpo, samples = settings.grpo, settings.evaluation.samples
    during = evaluations_during(settings.evaluation, grpo.steps or 0, begun_at=progress.step)
    by_label = {BEFORE: samples, AFTER: samples, DURING: settings.evaluation.samples_during if during else 0}
    counts = {BEFORE: 0 if progress.grpo_ready else 1, DURING: during, AFTER: 1}
    total = len(start.evaluated) * sum(counts[label] * each for label, each in by_label.items())
    grpo_phase = PhaseTime(
        typical_s=GRPO_STEP_S * grpo.steps if typical and grpo.steps else None,
        budget_s=60 * grpo.minutes if grpo.steps is None else None,
        share=_share(progress.step, progress.grpo_s, grpo.steps, 60 * grpo.minutes),
    )
    evaluation = PhaseTime(typical_s=PLAN_S * total if typical else None, share=0.0 if total else 1.0)
    phases = {Phase.IMITATION: _imitation(start), Phase.GRPO: grpo_phase, Phase.EVALUATION: evaluation}
    return RunClock(phases, began_s=began_s, samples=by_label, plans=total, warn_after_s=warn_after_s)


def imitation_clock(start: RunStart, *, began_s: float) -> RunClock:
    """Return the clock of a run that ends with imitation."""
    return RunClock({Phase.IMITATION: _imitation(start)}, began_s=began_s)


def _imitation(start: RunStart) -> PhaseTime:
    settings, state = start.settings.imitation, start.progress.imitation
    is_over = state.done or start.progress.grpo_ready
    return PhaseTime(
        typical_s=IMITATION_STEP_S * settings.steps
        if _is_typical(start.settings) and settings.steps
        else None,
        budget_s=settings.seconds if settings.steps is None else None,
        share=1.0 if is_over else _share(state.step, state.seconds, settings.steps, settings.seconds),
    )


def _is_typical(settings: TrainSettings) -> bool:
    """Return True for runs with typical times: of the word-level policy, on whole plans."""
    return is_word_level(settings.model) and settings.episodes.visibility is None


def _share(step: int, spent_s: float, steps: int | None, budget_s: float) -> float:
    """Return the used share of a budget of steps, or of seconds if there are none."""
    done, budget = (spent_s, budget_s) if steps is None else (step, steps)
    return min(1.0, done / budget) if budget else 1.0
