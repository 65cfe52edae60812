"""What a run begins with: settings, tasks and a policy, new or from a checkpoint."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch

from embomatrix.host.cores import usable_cores
from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, read_settings, with_changes
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.loading import TINY, is_tiny, new_policy, saved_policy
from embomatrix.trainer.policy.prompts import Teller

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TaskSet
    from embomatrix.trainer.policy.protocol import Policy


MAY_CHANGE: Final = frozenset(
    {
        *("device", "threads", "processes", "track", "checkpoint_every", "keep_checkpoints", "samples_every"),
        *("grpo.minutes", "grpo.steps", "imitation.seconds", "imitation.steps", "imitation.chunk"),
    }
)
"""Settings that may differ when a run goes on: how long it takes, where it runs and in how much memory, what is told of it."""
LATER: Final = ("grpo.", "reward.", "evaluation.")
"""Settings of what comes after imitation: until then they may change too."""


@dataclass(frozen=True)
class Start:
    """``progress`` is a checkpoint's when a run goes on."""

    settings: TrainSettings
    tasks: TaskSet
    policy: Policy
    progress: TrainingProgress

    @property
    def teller(self) -> Teller:
        return teller_for(self.policy, self.tasks, self.settings)


def started(
    dataset: Path, out: Path, model: str, settings_file: Path | None, changes: Mapping[str, Any]
) -> Start:
    """A new run in the folder ``out``, which is made. Raises TrainerError where there is one already."""
    defaults = {"threads": usual_threads(), **({} if is_tiny(model) else _language_defaults(model))}
    settings = read_settings(settings_file, {**changes, "model": model}, defaults)
    if "processes" not in settings.model_fields_set:
        settings = settings.model_copy(update={"processes": _processes_for(settings)})
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
    return Start(settings, tasks, policy, TrainingProgress(dataset=digest_of(tasks)))


def usual_threads() -> int:
    """Half of the cores: simulation on the same machine needs the others."""
    return max(1, usable_cores() // 2)


def _language_defaults(model: str) -> dict[str, Any]:
    """A model that was taught here goes on in the codec that it was taught in."""
    codec = HfPolicy.codec_in(Path(model))
    return {**LANGUAGE_MODEL_DEFAULTS, **({} if codec is None else {"codec": codec})}


def _processes_for(settings: TrainSettings) -> int:
    """What suits a model: on a processor the small policy takes a step in half the time in two processes, a language model
    would take a second one's memory."""
    shared = is_tiny(settings.model) and settings.device == "cpu"
    return min(2, usable_cores()) if shared else 1


def resumed(
    dataset: Path,
    out: Path,
    changes: Mapping[str, Any],
    *,
    model: str = TINY,
    settings_file: Path | None = None,
) -> Start:
    """The run in ``out``, from its newest checkpoint.

    Raises TrainerError where there is none, or where it was begun with other tasks or with settings that may not change.
    """
    newest = CheckpointStore(out / CHECKPOINTS, keep=1).latest()
    if newest is None:
        raise TrainerError(
            f"there is no checkpoint in {out} to resume from: leave out --resume, or pass its --out"
        )
    progress, begun = read_state(newest)
    told = _flat(read_settings(settings_file, {}).model_dump(exclude_unset=True))
    told |= {key: value for key, value in changes.items() if value is not None}
    told |= {} if model == TINY else {"model": model}
    settings = with_changes(begun.model_dump(), told)
    _check_unchanged(out, begun, settings, prepared=progress.prepared)
    tasks = loaded(dataset, settings)
    if progress.dataset not in ("", digest_of(tasks)):
        raise TrainerError(
            f"the run in {out} was begun with other tasks than those of {dataset}: pass the --dataset that it was begun with, "
            "or begin a new run with another --out"
        )
    return Start(settings, tasks, saved_policy(newest / "policy", settings), progress)


def _check_unchanged(out: Path, begun: TrainSettings, now: TrainSettings, *, prepared: bool) -> None:
    """Raises TrainerError for the first setting that differs and decides what is learnt."""
    before, after = _flat(begun.model_dump()), _flat(now.model_dump())
    for key, value in after.items():
        free = key in MAY_CHANGE or (not prepared and key.startswith(LATER))
        if value != before[key] and not free:
            raise TrainerError(
                f"the run in {out} was begun with {key} = {before[key]!r}, and is to go on with {value!r}: leave that out, or "
                "begin a new run with another --out"
            )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def digest_of(tasks: TaskSet) -> str:
    """Names all tasks of a dataset, and the scenes that they are in."""
    lines = (f"{task.task.task_id} {task.bundle_digest}" for task in (*tasks.train, *tasks.heldout))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


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
    variation = Variation(tasks.kinds, told.rename_share, told.drop_share)
    return Teller(policy, told.rows, variation, told.practice_rename_share)
