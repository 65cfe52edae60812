"""`bench trainer`: GRPO steps beside TRL's, a short run on a cluster, an evaluation of stored answers."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.bench.cluster.processes import output_of
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.trainer.memory import random_llama_error
from embomatrix.bench.trainer.steps import load_of, own_step_s, trl_step_s
from embomatrix.cli.local_cluster import local_cluster
from embomatrix.cli.supervisor import embomatrix_command
from embomatrix.host.limits import usable_cores
from embomatrix.pages.figures import Better, Figure
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.lifecycle.stopwatch import TimeShares
from embomatrix.trainer.logging.recorder import read_metrics

logger = logging.getLogger(__name__)

PROMPTS: Final = 24
"""Tasks that the compared steps draw their prompts from."""
IMITATION_STEPS: Final = 120
"""After these most texts are plans, so the cluster executes plans of usual length."""
FIRST_STEPS: Final = 15
UNMEASURED_STEPS: Final = 40
"""Steps in which scenes are loaded for the first time."""
GRPO_STEPS: Final = 70
TASKS: Final = 100
SAMPLES: Final = 10


def bench_trainer(dataset: Path, trl: Path | None, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure steps, a run and an evaluation.

    ``trl`` is the interpreter of an environment with TRL. Raise BenchError.
    """
    with tempfile.TemporaryDirectory(prefix="embo-") as name:
        folder = Path(name)
        steps = measure_steps(dataset, trl, folder, on_step)
        return (*steps, *_run(dataset, folder, on_step), *_evaluation(dataset, folder, on_step))


def bench_gpu_trainer(dataset: Path, trl: Path | None, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure steps of a large model with random weights on a GPU. ``trl`` and errors as for ``bench_trainer``."""
    if find_spec("transformers") is None:
        raise BenchError("transformers is missing: `pip install 'embomatrix[hf]'`")
    from embomatrix.bench.trainer.gpu import bench_gpu

    with tempfile.TemporaryDirectory(prefix="embo-") as name:
        return bench_gpu(dataset, trl, Path(name), on_step)


def measure_steps(
    dataset: Path, trl: Path | None, folder: Path, on_step: Callable[[str], None]
) -> list[Figure]:
    """CPU seconds of a step, of both trainers one after the other."""
    try:
        tasks = load_tasks(dataset).train[:PROMPTS]
    except TrainerError as error:
        raise BenchError(str(error)) from error
    if find_spec("transformers") is None:
        logger.warning("steps are not measured: transformers is missing, `pip install 'embomatrix[hf]'`")
        return []
    load = load_of(tasks)
    on_step("our steps")
    own = own_step_s(load, tasks)
    on_step("the memory of our steps")
    plan_error = abs(random_llama_error(load, tasks))
    found = [
        Figure("grpo_step_cpu_s", float(np.median(own)), "s", Better.LOWER, len(own)),
        Figure("memory_plan_error", plan_error, "", Better.LOWER, 1, 0.15),
    ]
    if trl is None:
        return found
    on_step("TRL's steps")
    theirs = trl_step_s(load, trl, folder)
    ratio = float(np.median(theirs) / np.median(own))
    return [
        *found,
        Figure("trl_step_cpu_s", float(np.median(theirs)), "s", Better.NEITHER, len(theirs)),
        Figure("grpo_step_vs_trl", ratio, "×", Better.HIGHER, min(len(own), len(theirs)), 2.0),
    ]


def _run(dataset: Path, folder: Path, on_step: Callable[[str], None]) -> list[Figure]:
    """Time shares of GRPO steps, with simulation on the cores of this machine."""
    settings, out = folder / "settings.toml", folder / "run"
    settings.write_text(f"imitation.steps = {IMITATION_STEPS}\nevaluation.samples = 1\n", encoding="utf-8")
    cluster = local_cluster(folder / "cluster", workers=2, slots=1)
    on_step(f"{IMITATION_STEPS} steps of imitation and {GRPO_STEPS} of GRPO on a cluster")
    with cluster.supervisor:
        output_of(
            *embomatrix_command("train", f"--dataset={dataset}", f"--out={out}", f"--settings={settings}"),
            f"--steps={GRPO_STEPS}",
            f"--manager={cluster.address}",
        )
    steps = read_metrics(out)
    first, warm = steps[:FIRST_STEPS], steps[UNMEASURED_STEPS:]
    shares = shares_of(warm, steps[UNMEASURED_STEPS - 1]["spent_s"])
    rate = sum(record["rollouts"] for record in warm) / shares.seconds
    return [
        Figure("sim_wait_share", shares.waiting, "", Better.LOWER, len(warm), 0.05),
        Figure("overhead_ratio", shares.overhead, "", Better.LOWER, len(warm), 0.10),
        Figure("first_steps_wait_share", shares_of(first, {}).waiting, "", Better.LOWER, len(first)),
        Figure("training_rollouts_per_s", rate, "1/s", Better.HIGHER, len(warm)),
    ]


def shares_of(records: Sequence[Mapping[str, Any]], earlier_s: Mapping[str, float]) -> TimeShares:
    """Time shares of consecutive steps. ``earlier_s`` is the run's time before them by activity."""
    spent_s: Mapping[str, float] = records[-1]["spent_s"]
    since = {activity: spent - earlier_s.get(activity, 0.0) for activity, spent in spent_s.items()}
    return TimeShares(float(sum(record["seconds"] for record in records)), since)


def _evaluation(dataset: Path, folder: Path, on_step: Callable[[str], None]) -> list[Figure]:
    """Wall seconds of judging stored answers, start-up included."""
    jobs = f"--jobs={usable_cores()}"
    asked = ("--split=all", f"--tasks={TASKS}", f"--samples={SAMPLES}", "--baseline=random")
    on_step(f"random plans for {TASKS} tasks at most")
    command = embomatrix_command("eval", f"--bench={dataset}", *asked, jobs, f"--out={folder / 'asked'}")
    output_of(*command)
    answers = folder / "asked" / "answers.jsonl"
    on_step("an evaluation of stored answers")
    began_s = time.monotonic()
    output_of(*embomatrix_command("eval", f"--answers={answers}", jobs, f"--out={folder / 'judged'}"))
    spent_s = time.monotonic() - began_s
    with answers.open(encoding="utf-8") as file:
        count = sum(1 for _ in file) - 1  # the first line is the header
    return [Figure("eval_s", spent_s, "s", Better.LOWER, count, 120.0)]
