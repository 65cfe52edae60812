"""What a finished run leaves for programs: one JSON file, written last, so that a folder which holds one is done."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.lifecycle.stopwatch import TimeShares
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

OUTCOME: Final = "outcome.json"
SCHEMA: Final = 1


@dataclass(frozen=True, slots=True)
class TaskRate:
    """Success of one held-out task, in [0, 1]; None where every rollout of it was lost."""

    task_id: str
    category: str
    rate: float | None


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """Numbers of one run. ``before`` and ``after`` GRPO are empty where nothing was held out.

    ``spent_s`` are seconds by activity of the whole run, ``grpo_s`` those of GRPO's steps alone. ``peak_mb`` is the most memory
    that the trainer's process held at once, since it was last resumed; 0 where nobody looked.
    """

    model: str
    imitation_steps: int
    steps: int
    rollouts: int
    lost: int
    wall_s: float
    grpo_s: float
    spent_s: Mapping[str, float]
    before: tuple[TaskRate, ...]
    after: tuple[TaskRate, ...]
    peak_mb: float = 0.0

    @property
    def wait_share(self) -> float:
        """Share of GRPO's steps in which the trainer stood still for simulation; NaN without a step."""
        return TimeShares(self.grpo_s, self.spent_s).waiting

    @property
    def overhead(self) -> float:
        """Share of GRPO's steps in which the model neither sampled nor learnt: waiting and all that is around it."""
        return TimeShares(self.grpo_s, self.spent_s).overhead


def write_outcome(folder: Path, outcome: RunOutcome) -> Path:
    """Write it into a run's folder. Raises OSError."""
    path = folder / OUTCOME
    value = {"schema": SCHEMA, **asdict(outcome)}
    write_whole(path, (json.dumps(value, indent=1) + "\n").encode("utf-8"))
    return path


def read_outcome(folder: Path) -> RunOutcome:
    """What ``write_outcome`` wrote. Raises TrainerError where there is none, or it is damaged."""
    path = folder / OUTCOME
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if value.pop("schema") != SCHEMA:
            raise TrainerError(f"{path} is of another version: train again with another --out")
        for name in ("before", "after"):
            value[name] = tuple(TaskRate(**item) for item in value[name])
        return RunOutcome(**value)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrainerError(
            f"{path} is no outcome of a finished run ({reason_of(error)}): finish it with `embomatrix train --resume`"
        ) from error
