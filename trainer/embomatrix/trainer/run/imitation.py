"""Imitation phase of a run: log, checkpoints, resume."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from embomatrix.trainer.episodes.oracle import OracleExamples
from embomatrix.trainer.episodes.teacher import Teacher
from embomatrix.trainer.imitation.teacher_forcing import Imitation, ImitationProgress
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, restore
from embomatrix.trainer.logging.recorder import IMITATION, Recorder
from embomatrix.trainer.run.starting import RunStart

LOG_EVERY: Final = 10
"""Steps between two lines of the log. Steps with a validation loss are always logged."""


def run_imitation(
    start: RunStart,
    workers: DataParallelWorkers,
    out: Path,
    recorder: Recorder,
    report: Callable[[ImitationProgress], None],
    episodes: OracleExamples | None = None,
    teacher: Teacher | None = None,
) -> None:
    """Use up the imitation budget and keep the progress current. A checkpoint is always left. Raises TrainerError.

    ``episodes`` are imitated instead of plans, if they are given, and those that a ``teacher`` adds to them.
    """
    policy, progress, settings = start.policy, start.progress, start.settings
    store = CheckpointStore(out / CHECKPOINTS, keep=settings.keep_checkpoints)
    state = progress.imitation
    imitation = Imitation(
        policy,
        workers,
        episodes or start.prompt_builder,
        episodes.tasks if episodes else start.tasks.train,
        settings.imitation,
        seed=settings.seed,
        state=state,
    )
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

    def prepare(share: float) -> None:
        if teacher is not None:
            teacher.teach_if_due(share, imitation.training)

    try:
        imitation.run(on_step, prepare)
    finally:
        if state.step:
            store.save(policy, imitation.tensors(), progress, settings)
