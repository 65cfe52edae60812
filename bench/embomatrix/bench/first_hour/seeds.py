"""Seeds of the demo, each in processes and a folder of its own: GRPO, and imitation that goes on for the same time."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from pydantic import TypeAdapter

from embomatrix.bench.first_hour.record import Arm, SeedRun
from embomatrix.bench.report.figures import BenchError
from embomatrix.host.code_version import commit_here
from embomatrix.trainer.lifecycle.checkpoint import newest_checkpoint, read_state
from embomatrix.trainer.lifecycle.stopwatch import Activity
from embomatrix.trainer.logging.outcome import OUTCOME, RunOutcome, rates_by_task, read_outcome
from embomatrix.trainer.logging.recorder import read_metrics

OnStep = Callable[[str], None]

FINISHED: Final = "finished.json"
"""File beside a run that has finished."""
LOG: Final = "log.txt"
CURVE: Final = ("step", "reward", "success", "gradient_norm")
"""Figures of a step that tell two runs apart. Others may be added or renamed, and times never repeat."""


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """Budgets of a finished run, the code and the platform that it ran on, and its time. ``core_s``: CPU of its processes."""

    options: Mapping[str, int]
    commit: str
    platform: str
    wall_s: float
    core_s: float


def run_seed(seed: int, folder: Path, options: Mapping[str, int], on_step: OnStep) -> SeedRun:
    """Run both arms of a seed, or read those that have finished. ``options`` are budgets for `embomatrix demo`.

    Imitation goes on for as many steps as take the time of GRPO. Raise BenchError if a run fails.
    """
    trained = _arm(folder / f"seed-{seed}-grpo", seed, options, on_step)
    continued = _arm(folder / f"seed-{seed}-imitation", seed, _as_long(trained, options), on_step)
    return _read_seed(seed, trained, continued)


def _as_long(trained: Path, options: Mapping[str, int]) -> Mapping[str, int]:
    """Return budgets of imitation alone that takes as long as a run with GRPO did."""
    outcome = read_outcome(trained)
    further = round(outcome.imitation_steps * outcome.grpo_s / outcome.spent_s[Activity.IMITATION])
    return {**options, "imitate-steps": outcome.imitation_steps + further, "steps": 0}


def _read_seed(seed: int, trained: Path, continued: Path) -> SeedRun:
    newest = newest_checkpoint(trained)
    if newest is None:
        raise BenchError(f"{trained} has no checkpoint: remove it, and run the command again")
    progress, _ = read_state(newest)
    outcome, finished = read_outcome(trained), _finished(trained)
    return SeedRun(
        seed=seed,
        dataset=progress.dataset,
        commit=finished.commit,
        platform=finished.platform,
        curve=curve_digest(read_metrics(trained)),
        imitated=rates_by_task(outcome.before),
        trained=_arm_of(trained, outcome),
        continued=_arm_of(continued, read_outcome(continued)),
    )


def platform_here() -> str:
    """Name what decides the rounding of numbers: processor family, Python and torch."""
    return f"{platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}"


def curve_digest(metrics: list[dict[str, Any]]) -> str:
    """Digest of the ``CURVE`` of all steps."""
    rows = [{name: row[name] for name in CURVE} for row in metrics]
    return hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()[:16]


def _arm(out: Path, seed: int, options: Mapping[str, int], on_step: OnStep) -> Path:
    """Run one arm, unless its outcome is there. An unfinished one starts anew."""
    if (out / FINISHED).exists():
        if (before := _finished(out).options) != options:
            raise BenchError(
                f"{out} was run with other budgets ({_told(before)}, now {_told(options)}): name another folder with --out, or "
                "remove it"
            )
        return out
    on_step(out.name)
    log = out.with_suffix(f".{LOG}")
    if out.exists() and not log.exists():
        raise BenchError(
            f"{out} was not written by this command: name another folder with --out, or move it away"
        )
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    given = [f"--{name}={value}" for name, value in options.items()]
    where = [f"--out={out}", f"--dataset={out.parent / 'dataset'}"]
    began = time.monotonic()
    with log.open("wb") as file:
        command = [sys.executable, "-m", "embomatrix.cli", "demo", f"--seed={seed}", *where, *given]
        with subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as started:
            # Tells what this run and its processes used.
            _, status, used = os.wait4(started.pid, 0)
            started.returncode = os.waitstatus_to_exitcode(status)
    if started.returncode or not (out / OUTCOME).exists():
        raise BenchError(
            f"the demo of seed {seed} ended with status {started.returncode}: read {log}, and run the command again"
        )
    ended = FinishedRun(
        dict(options), commit_here(), platform_here(), time.monotonic() - began, used.ru_utime + used.ru_stime
    )
    (out / FINISHED).write_bytes(TypeAdapter(FinishedRun).dump_json(ended))
    return out


def _told(options: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {value}" for name, value in options.items()) or "those of the demo"


def _finished(out: Path) -> FinishedRun:
    """Read what a finished run cost. Raise BenchError."""
    try:
        return TypeAdapter(FinishedRun).validate_json((out / FINISHED).read_bytes())
    except (OSError, ValueError) as error:
        raise BenchError(
            f"{out / FINISHED} can't be read ({error}): remove {out}, and run the command again"
        ) from error


def _arm_of(folder: Path, outcome: RunOutcome) -> Arm:
    finished = _finished(folder)
    # Without GRPO, the evaluation after imitation is the last one.
    rates = rates_by_task(outcome.after or outcome.before)
    return Arm(rates, outcome.imitation_steps, outcome.steps, finished.wall_s, finished.core_s)
