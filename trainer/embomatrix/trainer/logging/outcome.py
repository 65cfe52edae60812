"""Machine-readable result of a finished run: one JSON file, written last, so its presence marks a finished run."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.lifecycle.stopwatch import TimeShares
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

OUTCOME: Final = "outcome.json"
SCHEMA: Final = 1


@dataclass(frozen=True, slots=True)
class TaskRate:
    """Success rate of one held-out task, None if all of its rollouts were lost."""

    task_id: str
    category: str
    rate: float | None


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """Numbers of one run. ``before`` and ``after`` GRPO are empty without held-out tasks.

    ``spent_s`` are seconds of the whole run by activity, ``grpo_s`` seconds of the GRPO steps. ``peak_mb`` is the peak memory
    of the trainer process since the last resume in MB, 0 if unknown.
    """

    model: str
    imitation_steps: int
    steps: int
    rollouts: int
    lost: int
    wall_s: float
    grpo_s: float
    spent_s: dict[str, float]
    before: tuple[TaskRate, ...]
    after: tuple[TaskRate, ...]
    peak_mb: float = 0.0

    @property
    def shares(self) -> TimeShares:
        """Time shares of the GRPO steps; NaN without steps."""
        return TimeShares(self.grpo_s, self.spent_s)


def rates_by_task(rates: Iterable[TaskRate]) -> dict[str, float]:
    """Return the success rates by task, without the tasks whose rollouts were all lost."""
    return {rate.task_id: rate.rate for rate in rates if rate.rate is not None}


def write_outcome(folder: Path, outcome: RunOutcome) -> None:
    """Write the outcome into a run's folder. Raises OSError."""
    value = {"schema": SCHEMA, **asdict(outcome)}
    write_whole(folder / OUTCOME, (json.dumps(value, indent=1) + "\n").encode("utf-8"))


def read_outcome(folder: Path) -> RunOutcome:
    """Read an outcome. Raises TrainerError if it is missing or damaged."""
    path = folder / OUTCOME
    try:
        value: dict[str, Any] = parse_json(path.read_bytes())
        if value.pop("schema") != SCHEMA:
            raise TrainerError(f"{path} has another version than {SCHEMA}: train again with another --out")
        return TypeAdapter(RunOutcome).validate_python(value)
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise TrainerError(
            f"{path} is not the outcome of a finished run ({reason_of(error)}): finish the run with `embomatrix train --resume`"
        ) from error
