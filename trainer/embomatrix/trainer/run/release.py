"""Release of a run's policy: its newest checkpoint without the state of training, with a card that says what it is."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.host.code_version import commit_here
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.intervals import mean_over_tasks, paired_difference
from embomatrix.trainer.lifecycle.checkpoint import STATE, atomic_folder, newest_checkpoint, read_state
from embomatrix.trainer.logging.outcome import OUTCOME, RunOutcome, rates_by_task, read_outcome
from embomatrix.trainer.policy.loading import is_word_level

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.lifecycle.checkpoint import TrainingProgress
    from embomatrix.trainer.logging.outcome import TaskRate

CARD: Final = "CARD.md"
POLICY: Final = "policy"


def release(run: Path, out: Path, command: str) -> Path:
    """Write the policy of a finished run with its card to a new folder, which can be evaluated and played.

    ``command`` is the one that trained it. Raises TrainerError for an unfinished run, or if ``out`` exists.
    """
    if out.exists():
        raise TrainerError(f"{out} exists: give a new folder, or remove it")
    outcome = read_outcome(run)
    newest = newest_checkpoint(run)
    if newest is None:
        raise TrainerError(f"{run} has no checkpoint: give the folder of a run, such as runs/demo")
    progress, settings = read_state(newest)
    made = datetime.fromtimestamp((run / OUTCOME).stat().st_mtime, UTC)
    card = card_of(outcome, progress, settings, command, f"{made:%Y-%m-%d}")
    with atomic_folder(out) as partial:
        shutil.copytree(newest / POLICY, partial / POLICY)
        shutil.copy(newest / STATE, partial / STATE)
        (partial / CARD).write_text(card, encoding="utf-8")
    return out


def card_of(
    outcome: RunOutcome, progress: TrainingProgress, settings: TrainSettings, command: str, day: str
) -> str:
    """Return the card as Markdown."""
    gain = paired_difference(rates_by_task(outcome.before), rates_by_task(outcome.after))
    lines = [
        f"# {'A small policy' if is_word_level(settings.model) else 'A language model'} for household plans",
        "",
        f"Trained on {day} by `{command}`: {outcome.imitation_steps} steps of imitation and {outcome.steps} of GRPO "
        f"with {outcome.rollouts:,} rollouts, seed {settings.seed}, in {outcome.wall_s / 60:.0f} minutes. The card was written "
        f"at `{commit_here()}`. Digest of the tasks that it was trained and tested on: `{progress.dataset}`.",
        "",
        "Success on held-out tasks, mean over tasks and samples, with 95 % intervals over tasks:",
        "",
        "| category | tasks | after imitation | after GRPO |",
        "| --- | ---: | ---: | ---: |",
    ]
    for category in ("", *sorted({rate.category for rate in outcome.after})):
        before, after = (_of(rates, category) for rates in (outcome.before, outcome.after))
        lines.append(
            f"| {(category or 'all').replace('_', ' ')} | {len(after)} | {_success(before)} | {_success(after)} |"
        )
    value, low, high = (100 * share for share in (gain.value, gain.low, gain.high))
    lines += [
        "",
        f"Difference: {value:+.1f} points [{low:.1f}, {high:.1f}]. One seed.",
        "",
        *_about(settings),
    ]
    return "\n".join(lines) + "\n"


def _about(settings: TrainSettings) -> list[str]:
    known = "It knows no scene but that of its prompt, and was never tried on a real robot."
    if not is_word_level(settings.model):
        return [f"Trained from `{settings.model}`, whose licence holds for these weights too. {known}"]
    words = "It reads instructions of the words that its training tasks use, and fails at most others."
    return [f"{words} {known} Licence: MIT, as the package."]


def _of(rates: Sequence[TaskRate], category: str) -> list[float]:
    return [rate.rate for rate in rates if category in ("", rate.category) and rate.rate is not None]


def _success(rates: Sequence[float]) -> str:
    return mean_over_tasks(rates).interval.as_percent()
