"""Atomic checkpoints with the complete state of a run."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.policy.protocol import Policy
from embomatrix.trainer.policy.tensor_file import read_tensors
from embomatrix.world.json_text import parse_json

SCHEMA = 3
CHECKPOINTS = "checkpoints"
"""Name of the checkpoints folder in a run's folder."""
STATE = "state.json"
_TENSORS = "training.pt"
_PREFIXES = ("imitation-", "step-")
"""Folder prefixes of the two phases. Their alphabetical order is the order of the phases."""
DISK_FULL_BYTES = 8 * 1024 * 1024
"""A disk with less free space counts as full, because torch does not report why a write failed."""


@dataclass
class ImitationState:
    """State of imitation. ``best_loss`` is the lowest of the validation ``losses``, found at ``best_step``.

    ``stale_evaluations`` counts the evaluations since then.
    """

    step: int = 0
    seconds: float = 0.0
    best_loss: float | None = None
    best_step: int = 0
    stale_evaluations: int = 0
    losses: list[float] = field(default_factory=list)
    done: bool = False


@dataclass
class TrainingProgress:
    """Position of a run. ``cursor`` and ``reserve_cursor`` are positions in the two task schedules.

    ``grpo_ready``: imitation and the evaluation after it are done, and the reference policy is saved. ``grpo_s`` are seconds of
    GRPO, ``spent_s`` seconds of the whole run by activity. ``dataset`` is a digest of the run's tasks.
    """

    step: int = 0
    cursor: int = 0
    reserve_cursor: int = 0
    rollouts: int = 0
    lost: int = 0
    imitation: ImitationState = field(default_factory=ImitationState)
    grpo_ready: bool = False
    grpo_s: float = 0.0
    spent_s: dict[str, float] = field(default_factory=dict)
    before: list[dict[str, Any]] = field(default_factory=list)
    dataset: str = ""


class CheckpointStore:
    """Checkpoints of one run, one folder each: ``imitation-000800``, ``step-000050``. The newest ``keep`` are kept."""

    def __init__(self, folder: Path, *, keep: int) -> None:
        self._folder = folder
        self._keep = keep

    def save(
        self, policy: Policy, tensors: Mapping[str, Any], progress: TrainingProgress, settings: TrainSettings
    ) -> Path:
        """Write a checkpoint atomically: a crash leaves the previous one intact. Raises TrainerError."""
        number = progress.step if progress.grpo_ready else progress.imitation.step
        final = self._folder / f"{_PREFIXES[progress.grpo_ready]}{number:06d}"
        with atomic_folder(final) as partial:
            policy.save(partial / "policy")
            torch.save(dict(tensors), partial / _TENSORS)
            state = {
                "schema": SCHEMA,
                "progress": asdict(progress),
                "settings": settings.model_dump(mode="json"),
            }
            (partial / STATE).write_text(json.dumps(state, indent=1), encoding="utf-8")
            _sync(partial)
        for old in self._all()[: -self._keep]:
            shutil.rmtree(old, ignore_errors=True)
        return final

    def latest(self) -> Path | None:
        """Return the folder of the newest complete checkpoint."""
        return max(self._all(), default=None)

    def _all(self) -> list[Path]:
        return sorted(
            path
            for prefix in _PREFIXES
            for path in self._folder.glob(f"{prefix}*")
            if (path / STATE).is_file()
        )


def newest_checkpoint(run: Path) -> Path | None:
    """Return the folder of the newest complete checkpoint in a run's folder."""
    return CheckpointStore(run / CHECKPOINTS, keep=1).latest()


@contextlib.contextmanager
def atomic_folder(final: Path) -> Iterator[Path]:
    """Yield an empty folder that is renamed to ``final`` at the end. On an error, nothing is left. Raises TrainerError."""
    partial = final.with_name(f".{final.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        yield partial
        shutil.rmtree(final, ignore_errors=True)
        os.replace(partial, final)
    except (OSError, RuntimeError) as error:  # torch's writer raises RuntimeError for a full disk
        full = shutil.disk_usage(final.parent if final.parent.is_dir() else ".").free < DISK_FULL_BYTES
        raise TrainerError(
            f"{final} can't be written ({'the disk is full' if full else reason_of(error)}): free space or fix the "
            "permissions; earlier checkpoints are intact, and --resume continues from the newest"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def read_state(folder: Path) -> tuple[TrainingProgress, TrainSettings]:
    """Read a checkpoint's progress and settings. Raises TrainerError if it is damaged or of another version."""
    try:
        state = parse_json((folder / STATE).read_bytes())
        if state["schema"] != SCHEMA:
            raise TrainerError(
                f"the checkpoint {folder} has schema {state['schema']}, this version reads {SCHEMA}: start a new run"
            )
        progress = TrainingProgress(**state["progress"])
        progress.imitation = ImitationState(**state["progress"]["imitation"])
        return progress, TrainSettings.model_validate(state["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f"{folder} is not a readable checkpoint ({STATE}: {reason_of(error)}): pass a folder such as "
            "runs/NAME/checkpoints/step-000050"
        ) from error


def restore(folder: Path, load: Callable[[dict[str, Any]], object]) -> None:
    """Pass the saved tensors (without the policy) to ``load``. Raises TrainerError if they are damaged."""
    try:
        load(read_tensors(folder / _TENSORS))
    except DAMAGE as error:
        raise TrainerError(
            f"{folder / _TENSORS} is damaged ({reason_of(error)}): remove {folder}, and --resume continues from the "
            "checkpoint before it"
        ) from error
