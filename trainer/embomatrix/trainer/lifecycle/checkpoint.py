"""Checkpoints: everything that decides how training goes on, written whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.imitation.teacher_forcing import ImitationState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from embomatrix.trainer.policy.protocol import Policy

SCHEMA = 3
CHECKPOINTS = "checkpoints"
"""Their folder in a run's."""
_STATE = "state.json"
_TENSORS = "training.pt"
_PREFIXES = ("imitation-", "step-")
"""Of the two phases of a run, in their order, which is also that of their names."""
FULL_BYTES = 8 * 1024 * 1024
"""With less than this left, a disk counts as full: torch does not tell why a file can't be written."""


@dataclass
class TrainingProgress:
    """Where a run stands. ``cursor`` is the schedule's, ``reserve_cursor`` that of the reserve.

    ``prepared``: imitation and the evaluation after it are done, and the reference is kept. Seconds are of GRPO and, by
    activity, of the whole run. ``dataset`` is a digest of the tasks that the run began with; "": nobody kept it.
    """

    step: int = 0
    cursor: int = 0
    reserve_cursor: int = 0
    rollouts: int = 0
    lost: int = 0
    imitation: ImitationState = field(default_factory=ImitationState)
    prepared: bool = False
    grpo_s: float = 0.0
    spent_s: dict[str, float] = field(default_factory=dict)
    before: list[dict[str, Any]] = field(default_factory=list)
    dataset: str = ""


class CheckpointStore:
    """Checkpoints of one run, a folder each: ``imitation-000800``, ``step-000050``. The newest ``keep`` stay."""

    def __init__(self, folder: Path, *, keep: int) -> None:
        self._folder = folder
        self._keep = keep

    def save(
        self, policy: Policy, tensors: Mapping[str, Any], progress: TrainingProgress, settings: TrainSettings
    ) -> Path:
        """Write beside, sync, then rename: a crash leaves the last checkpoint as it was. Raises TrainerError."""
        number = progress.step if progress.prepared else progress.imitation.step
        final = self._folder / f"{_PREFIXES[progress.prepared]}{number:06d}"
        with whole_folder(final) as partial:
            policy.save(partial / "policy")
            torch.save(dict(tensors), partial / _TENSORS)
            state = {
                "schema": SCHEMA,
                "progress": asdict(progress),
                "settings": settings.model_dump(mode="json"),
            }
            (partial / _STATE).write_text(json.dumps(state, indent=1), encoding="utf-8")
            _sync(partial)
        for old in self._all()[: -self._keep]:
            shutil.rmtree(old, ignore_errors=True)
        return final

    def latest(self) -> Path | None:
        """Folder of the newest whole checkpoint."""
        found = self._all()
        return found[-1] if found else None

    def _all(self) -> list[Path]:
        if not self._folder.is_dir():
            return []
        return sorted(
            path
            for prefix in _PREFIXES
            for path in self._folder.glob(f"{prefix}*")
            if (path / _STATE).is_file()
        )


@contextlib.contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """An empty folder to fill, which becomes ``final`` at the end. Raises TrainerError, and leaves nothing, if that fails."""
    partial = final.with_name(f".{final.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        yield partial
        shutil.rmtree(final, ignore_errors=True)
        os.replace(partial, final)
    except (OSError, RuntimeError) as error:  # torch's writer raises RuntimeError where a disk is full
        full = shutil.disk_usage(final.parent if final.parent.is_dir() else ".").free < FULL_BYTES
        raise TrainerError(
            f"{final} can't be written ({'the disk is full' if full else reason_of(error)}): make room there, or give rights; "
            "checkpoints before it are whole, and --resume goes on from the newest"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def read_state(folder: Path) -> tuple[TrainingProgress, TrainSettings]:
    """What a checkpoint says of the run. Raises TrainerError where it is none, or of another version."""
    try:
        state = json.loads((folder / _STATE).read_text(encoding="utf-8"))
        if state["schema"] != SCHEMA:
            raise TrainerError(
                f"the checkpoint {folder} has schema {state['schema']}, this version reads {SCHEMA}: start a new run"
            )
        progress = TrainingProgress(**state["progress"])
        progress.imitation = ImitationState(**state["progress"]["imitation"])
        return progress, TrainSettings.model_validate(_of_today(state["settings"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f"{folder} is no readable checkpoint ({_STATE}: {reason_of(error)}): pass a folder such as "
            "runs/NAME/checkpoints/step-000050"
        ) from error


def _of_today(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of a checkpoint; once `products` was the small policy's alone."""
    tiny = dict(settings["tiny"])
    moved = {"products": tiny.pop("products")} if "products" in tiny else {}
    return {**settings, "tiny": tiny, **moved}


def restore(folder: Path, put_back: Callable[[dict[str, Any]], object]) -> None:
    """Give ``put_back`` what was saved besides the policy. Raises TrainerError where that is damaged."""
    try:
        put_back(torch.load(folder / _TENSORS, map_location="cpu", weights_only=True))
    except DAMAGE as error:
        raise TrainerError(
            f"{folder / _TENSORS} is damaged ({reason_of(error)}): remove {folder}, and --resume goes on from the "
            "checkpoint before it"
        ) from error
