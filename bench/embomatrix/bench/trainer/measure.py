"""What `embomatrix bench trainer` does: steps against TRL's, a short run on a cluster, an evaluation of stored answers.

The command finds this by entry point: the worker's package, where the other benches are, imports nothing of the trainer.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.trainer.load import load_of, write_load
from embomatrix.cli.local_cluster import local_cluster, without_membership
from embomatrix.cli.supervisor import embomatrix_command
from embomatrix.host.cores import usable_cores
from embomatrix.pages.figures import Better, Figure
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.lifecycle.stopwatch import TimeShares
from embomatrix.trainer.logging.recorder import read_metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

PROMPTS: Final = 24
LIMIT_S: Final = 1800.0
"""For each program: on a machine that is shared they take many times as long as alone."""
IMITATION_STEPS: Final = 120
"""After which most texts are plans: what the cluster then executes is what it executes in training."""
FIRST_STEPS: Final = 15
UNMEASURED_STEPS: Final = 40
"""In which scenes are loaded for the first time."""
GRPO_STEPS: Final = 70
TASKS: Final = 100
SAMPLES: Final = 10
OWN_STEPS: Final = "embomatrix.bench.trainer.own_steps"
TRL_STEPS: Final = "embomatrix.bench.trainer.trl_steps"


def bench_trainer(
    dataset: Path, trl: Path | None, parts: Collection[str], on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Figures of the parts ``step``, ``run`` and ``eval``. ``trl``: the interpreter of an environment with TRL.

    Raises BenchError.
    """
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory(prefix="embo-") as name:
        folder = Path(name)
        if "step" in parts:
            figures += _steps(dataset, trl, folder, on_step)
        if "run" in parts:
            figures += _run(dataset, folder, on_step)
        if "eval" in parts:
            figures += _evaluation(dataset, folder, on_step)
    return tuple(figures)


def _steps(dataset: Path, trl: Path | None, folder: Path, on_step: Callable[[str], None]) -> list[Figure]:
    """Processor seconds of a step, of both trainers one after the other."""
    load = folder / "load.json"
    try:
        write_load(load, load_of(load_tasks(dataset).train[:PROMPTS]))
    except TrainerError as error:
        raise BenchError(str(error)) from error
    on_step("our steps")
    own = seconds_told(_told(sys.executable, "-m", OWN_STEPS, str(load), str(dataset)))
    found = [Figure("grpo_step_cpu_s", float(np.median(own)), "s", Better.LOWER, len(own))]
    if trl is None:
        return found
    on_step("TRL's steps")
    spec = find_spec(TRL_STEPS)
    program = str(spec.origin if spec else "")
    # Nothing of ours is to be found by an environment that has its own pins.
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    theirs = seconds_told(_told(str(trl), program, str(load), environment=alone))
    ratio = float(np.median(theirs) / np.median(own))
    return [
        *found,
        Figure("trl_step_cpu_s", float(np.median(theirs)), "s", Better.NEITHER, len(theirs)),
        Figure("grpo_step_vs_trl", ratio, "×", Better.HIGHER, min(len(own), len(theirs)), 2.0),
    ]


def _run(dataset: Path, folder: Path, on_step: Callable[[str], None]) -> list[Figure]:
    """Where the time of GRPO's steps goes, with simulation on this machine's own cores."""
    settings, out = folder / "settings.toml", folder / "run"
    settings.write_text(f"imitation.steps = {IMITATION_STEPS}\nevaluation.samples = 1\n", encoding="utf-8")
    cluster = local_cluster(folder / "cluster", workers=2, slots=1)
    on_step(f"{IMITATION_STEPS} steps of imitation and {GRPO_STEPS} of GRPO on a cluster")
    with cluster.supervisor:
        _told(
            *embomatrix_command("train", f"--dataset={dataset}", f"--out={out}", f"--settings={settings}"),
            f"--steps={GRPO_STEPS}",
            f"--manager={cluster.address}",
        )
    steps = read_metrics(out)
    first = Shares.of(steps[:FIRST_STEPS], {})
    warm = Shares.of(steps[UNMEASURED_STEPS:], steps[UNMEASURED_STEPS - 1]["spent_s"])
    return [
        Figure("sim_wait_share", warm.waiting, "", Better.LOWER, warm.steps, 0.05),
        Figure("overhead_ratio", warm.overhead, "", Better.LOWER, warm.steps, 0.10),
        Figure("first_steps_wait_share", first.waiting, "", Better.LOWER, first.steps),
        Figure("training_rollouts_per_s", warm.rollouts_per_s, "1/s", Better.HIGHER, warm.steps),
    ]


@dataclass(frozen=True, slots=True)
class Shares:
    """Of the time of some steps in a row: what went to ``waiting`` for simulation, and to neither sampling nor update."""

    steps: int
    waiting: float
    overhead: float
    rollouts_per_s: float

    @classmethod
    def of(cls, records: Sequence[Mapping[str, Any]], earlier_s: Mapping[str, float]) -> Shares:
        """``earlier_s`` is what the run had spent before them, by activity."""
        seconds = float(sum(record["seconds"] for record in records))
        spent_s: Mapping[str, float] = records[-1]["spent_s"]
        since = {activity: spent - earlier_s.get(activity, 0.0) for activity, spent in spent_s.items()}
        shares = TimeShares(seconds, since)
        rollouts = sum(record["rollouts"] for record in records)
        return cls(len(records), shares.waiting, shares.overhead, rollouts / seconds)


def _evaluation(dataset: Path, folder: Path, on_step: Callable[[str], None]) -> list[Figure]:
    """Seconds on the clock to judge stored answers, starting included."""
    asked = (
        f"--bench={dataset}",
        "--split=all",
        f"--tasks={TASKS}",
        f"--samples={SAMPLES}",
        "--baseline=random",
    )
    jobs = f"--jobs={usable_cores()}"
    on_step(f"random plans for {TASKS} tasks")
    _told(*embomatrix_command("eval", *asked, jobs, f"--out={folder / 'asked'}"))
    answers = folder / "asked" / "answers.jsonl"
    on_step("an evaluation of stored answers")
    began_s = time.monotonic()
    _told(*embomatrix_command("eval", f"--answers={answers}", jobs, f"--out={folder / 'judged'}"))
    spent_s = time.monotonic() - began_s
    with answers.open(encoding="utf-8") as file:
        count = sum(1 for _ in file) - 1  # the first line says what was asked of whom
    return [Figure("eval_s", spent_s, "s", Better.LOWER, count, 120.0)]


def _told(*command: str, environment: Mapping[str, str] | None = None) -> str:
    """What a program says on standard output. Raises BenchError with its last words where it fails."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
            env=without_membership(environment or os.environ),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchError(
            f"{command[0]} can't be run ({error}): name another interpreter, or measure when it is quiet"
        ) from error
    if done.returncode:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:] or ["no words"]
        raise BenchError(
            f"`{' '.join(command[:4])} …` failed ({words[0][:300]}): mend that and measure again"
        )
    return done.stdout


def seconds_told(output: str) -> list[float]:
    """The steps' processor seconds, which a program told on its last line. Raises BenchError."""
    last = (output.strip().splitlines() or [""])[-1]
    try:
        value: Any = json.loads(last)
        return [float(each) for each in value["step_s"]]
    except (ValueError, KeyError, TypeError) as error:
        raise BenchError(
            f"a program told no times of steps ({last[:100]!r}): expected JSON with step_s"
        ) from error
