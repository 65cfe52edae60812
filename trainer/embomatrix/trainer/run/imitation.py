"""Imitation phase of a run: log, checkpoints, resume."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.imitation.teacher_forcing import Imitation, ImitationProgress
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, restore
from embomatrix.trainer.logging.recorder import IMITATION, Recorder
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.protocol import Policy

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TrainingTask

LOG_EVERY: Final = 10
"""Steps between two lines of the log. Steps with a validation loss are always logged."""


def run_imitation(
    policy: Policy,
    prompt_builder: PromptBuilder,
    tasks: Sequence[TrainingTask],
    settings: TrainSettings,
    out: Path,
    progress: TrainingProgress,
    recorder: Recorder,
    report: Callable[[ImitationProgress], None],
) -> None:
    """Use up the imitation budget and keep ``progress.imitation`` current. A checkpoint is always left. Raises TrainerError.

    If ``progress`` comes from a checkpoint, the policy must be that checkpoint's.
    """
    store = CheckpointStore(out / CHECKPOINTS, keep=settings.keep_checkpoints)
    state = progress.imitation
    imitation = Imitation(policy, prompt_builder, tasks, settings.imitation, seed=settings.seed, state=state)
    if state.done:
        return
    newest = store.latest() if state.step else None
    if newest is not None:
        restore(newest, imitation.restore)
    recorder.forget_after(state.step, IMITATION)
    saved_s = time.monotonic()

    def on_step(step: ImitationProgress) -> None:
        nonlocal saved_s
        if step.validation is not None or step.step % LOG_EVERY == 1:
            recorder.imitation(step)
        report(step)
        if time.monotonic() - saved_s >= settings.imitation.checkpoint_seconds:
            store.save(policy, imitation.tensors(), progress, settings)
            saved_s = time.monotonic()

    try:
        imitation.run(on_step)
    finally:
        if state.step:
            store.save(policy, imitation.tensors(), progress, settings)
