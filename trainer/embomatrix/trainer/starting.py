"""What a run begins with: settings, tasks and a policy, new or from a checkpoint."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from embomatrix.trainer.augment import Variation
from embomatrix.trainer.checkpoint import CHECKPOINTS, CheckpointStore, Progress, read_state
from embomatrix.trainer.data import load_tasks
from embomatrix.trainer.errors import TrainerError, reason_of
from embomatrix.trainer.policy.choice import is_tiny, new_policy, saved_policy
from embomatrix.trainer.settings import LANGUAGE_MODEL_DEFAULTS, read_settings, with_changes
from embomatrix.trainer.telling import Teller

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from embomatrix.trainer.data import TaskSet
    from embomatrix.trainer.policy.protocol import Policy
    from embomatrix.trainer.settings import TrainSettings


@dataclass(frozen=True)
class Start:
    """``progress`` is a checkpoint's when a run goes on."""

    settings: TrainSettings
    tasks: TaskSet
    policy: Policy
    progress: Progress | None = None

    @property
    def teller(self) -> Teller:
        return teller_for(self.policy, self.tasks, self.settings)


def started(
    dataset: Path, out: Path, model: str, settings_file: Path | None, changes: Mapping[str, Any]
) -> Start:
    """A new run in the folder ``out``, which is made. Raises TrainerError where there is one already."""
    threads = changes.get("threads") or max(1, (os.cpu_count() or 2) // 2)
    defaults = {} if is_tiny(model) else LANGUAGE_MODEL_DEFAULTS
    settings = read_settings(settings_file, {**changes, "model": model, "threads": threads}, defaults)
    if any((out / CHECKPOINTS).glob("[!.]*")):
        raise TrainerError(f"{out} holds another run: pass --resume to go on with it, or another --out")
    tasks = loaded(dataset, settings)
    policy = new_policy(settings, tasks)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainerError(
            f"the folder {out} can't be made ({error.strerror}): pass another --out"
        ) from error
    return Start(settings, tasks, policy)


def resumed(dataset: Path, out: Path, changes: Mapping[str, Any]) -> Start:
    """The run in ``out``, from its newest checkpoint. Raises TrainerError where there is none."""
    newest = CheckpointStore(out / CHECKPOINTS, keep=1).latest()
    if newest is None:
        raise TrainerError(
            f"there is no checkpoint in {out} to resume from: leave out --resume, or pass its --out"
        )
    progress, settings = read_state(newest)
    settings = with_changes(settings.model_dump(), changes)
    tasks = loaded(dataset, settings)
    return Start(settings, tasks, saved_policy(newest / "policy", settings), progress)


def has_checkpoint(out: Path) -> bool:
    """Whether the folder holds a run to go on with."""
    return CheckpointStore(out / CHECKPOINTS, keep=1).latest() is not None


def loaded(dataset: Path, settings: TrainSettings) -> TaskSet:
    """The dataset's tasks, once torch is known to have the device. Raises TrainerError."""
    torch.set_num_threads(settings.threads)
    try:
        torch.empty(0, device=settings.device)
    except (RuntimeError, AssertionError) as error:
        raise TrainerError(
            f"the device {settings.device!r} can't be used ({reason_of(error)}): expected cpu, or cuda where torch finds a GPU"
        ) from error
    return load_tasks(dataset)


def teller_for(policy: Policy, tasks: TaskSet, settings: TrainSettings) -> Teller:
    """Tells those tasks to that policy, as the settings say."""
    told = settings.prompt
    return Teller(policy, told.rows, Variation(tasks.kinds, told.rename_share, told.drop_share))
