"""Scripts on a dataset: plans of ``template``, ``nearest`` and ``greedy``, executed in the simulator, and their success."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from embomatrix.factory.admission import oracle_plan, plan_failure
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.pages.figures import Better, Figure, wilson
from embomatrix.scripts.examples import FittedScripts, ScriptExample, example_of
from embomatrix.scripts.greedy import greedy_plan
from embomatrix.scripts.nearest import NearestScript
from embomatrix.scripts.template import TemplateScript
from embomatrix.sim.process_pool import process_pool
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.prompt import Situation, situation_of
from embomatrix.skills.syntax import Plan
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord


class ScriptName(StrEnum):
    """Script without a model. ``template`` and ``nearest`` learn from training tasks; ``greedy`` knows the goal."""

    TEMPLATE = "template"
    NEAREST = "nearest"
    GREEDY = "greedy"


GOALS: Final[Mapping[ScriptName, float]] = {ScriptName.TEMPLATE: 0.45, ScriptName.NEAREST: 0.30}
"""Largest success of a script on the held-out tasks of a dataset that needs more than its training phrases."""
Group = TypeVar("Group")
Result = TypeVar("Result")
ScriptPlans = Mapping[str, Mapping[ScriptName, Plan]]
"""Plans by task id and script."""
ScriptResults = Mapping[str, Mapping[ScriptName, bool]]
"""Success by task id and script."""


def write_plans(dataset: Dataset, records: Sequence[TaskRecord], training: Dataset) -> ScriptPlans:
    """Return the scripts' plans for records of a dataset.

    Scripts learn from the training split of ``training``; no script has seen the task that it answers. Raises DatasetError for
    a bundle that can't be read, EvaluationError for a dataset without training tasks.
    """
    if not training.train:
        raise EvaluationError(
            f"{training.folder} has no training tasks to learn from: give a dataset that has some with --training"
        )
    situations = situations_of(dataset, records)
    known = situations_of(training, training.train)
    examples = [
        example_of(record, known[record.task.task_id], oracle_plan(record) if record.oracle else ())
        for record in training.train
    ]
    return _plans(records, situations, examples)


def situations_of(dataset: Dataset, records: Sequence[TaskRecord]) -> dict[str, Situation]:
    """Return the content of the prompt of each record, by task id. Bundles are decoded one at a time."""
    found: dict[str, Situation] = {}
    for digest, group in by_bundle(records).items():
        scene = dataset.read_bundle(digest).scene
        found |= {record.task.task_id: situation_of(scene, record.task) for record in group}
    return found


def _plans(
    records: Sequence[TaskRecord], situations: Mapping[str, Situation], examples: Sequence[ScriptExample]
) -> ScriptPlans:
    template = FittedScripts(TemplateScript.fit, examples)
    nearest = FittedScripts(NearestScript.fit, examples)
    return {
        task.task_id: {
            ScriptName.TEMPLATE: template.plan(task.task_id, situations[task.task_id]),
            ScriptName.NEAREST: nearest.plan(task.task_id, situations[task.task_id]),
            ScriptName.GREEDY: greedy_plan(task, situations[task.task_id]),
        }
        for task in (record.task for record in records)
    }


def run_scripts(
    dataset: Dataset,
    records: Sequence[TaskRecord],
    plans: ScriptPlans,
    *,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> ScriptResults:
    """Execute plans and call ``progress`` with the number of finished tasks. Equal plans of a task are executed once.

    Raises DatasetError if a bundle can't be read or a process dies.
    """
    found: dict[str, Mapping[ScriptName, bool]] = {}
    work = partial(_run_bundle, dataset.folder)
    groups = [
        (digest, {record.task.task_id: plans[record.task.task_id] for record in group})
        for digest, group in by_bundle(records).items()
    ]
    for results in in_processes(work, groups, jobs=jobs, doing="executes scripts"):
        found |= results
        progress(len(found))
    return found


def in_processes(
    work: Callable[[Group], Result], groups: Iterable[Group], *, jobs: int, doing: str
) -> Iterator[Result]:
    """Yield the results of the groups in their order. Raises DatasetError if a process dies; ``doing`` says at what work."""
    try:
        with process_pool(jobs) as pool:
            yield from pool.map(work, groups)
    except BrokenProcessPool as error:
        raise DatasetError(
            f"a process that {doing} died, perhaps out of memory: run the command again with fewer --jobs"
        ) from error


def _run_bundle(folder: Path, group: tuple[str, ScriptPlans]) -> dict[str, Mapping[ScriptName, bool]]:
    """Execute plans for tasks of one bundle. ``group`` holds the bundle's digest and the plans by task id."""
    digest, plans = group
    bundle = Dataset(folder, ()).read_bundle(digest)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        found: dict[str, Mapping[ScriptName, bool]] = {}
        for task_id, written in plans.items():
            task = bundle.tasks[task_id]
            succeeds = {plan: plan_failure(simulator, task, plan) is None for plan in set(written.values())}
            found[task_id] = {name: succeeds[plan] for name, plan in written.items()}
    return found


def by_bundle(records: Sequence[TaskRecord]) -> dict[str, list[TaskRecord]]:
    """Group records by the digest of their bundle."""
    found: dict[str, list[TaskRecord]] = {}
    for record in records:
        found.setdefault(record.bundle_digest, []).append(record)
    return found


def evaluation_of(results: ScriptResults, conditions: Mapping[str, str | int]) -> EvaluationFigures:
    """Return the success of each script, with its Wilson interval in a note."""
    figures, notes = [], []
    for name in ScriptName:
        held = [result[name] for result in results.values()]
        share = sum(held) / len(held)
        figure_name = f"{name}_success"
        figures.append(Figure(figure_name, share, "", Better.LOWER, len(held), GOALS.get(name)))
        interval = wilson(share, len(held))
        notes.append(f"{figure_name} {share:.3f} [{interval.low:.3f}, {interval.high:.3f}]")
    note = f"With 95 % Wilson intervals over tasks: {', '.join(notes)}."
    return EvaluationFigures("scripts", conditions, tuple(figures), (note,))


def evaluate_scripts(
    folder: Path,
    training: Path | None,
    *,
    jobs: int,
    counter: Callable[[str, int], contextlib.AbstractContextManager[Callable[[int], None]]],
) -> EvaluationFigures:
    """Measure the scripts on the held-out split of a dataset. Raises EvaluationError for one without held-out tasks."""
    dataset, learned, conditions = held_out_of(folder, training)
    plans = write_plans(dataset, dataset.heldout, learned)
    with counter("tasks", len(dataset.heldout)) as count:
        results = run_scripts(dataset, dataset.heldout, plans, jobs=jobs, progress=count)
    return evaluation_of(results, conditions)


def held_out_of(folder: Path, training: Path | None) -> tuple[Dataset, Dataset, dict[str, str | int]]:
    """Return a dataset with held-out tasks, the one whose training tasks are learned from, and conditions of measurement.

    Raises EvaluationError for a dataset without held-out tasks.
    """
    dataset = Dataset.load(folder)
    learned = dataset if training is None else open_dataset(training)
    if not dataset.heldout:
        raise EvaluationError(f"{folder} has no held-out tasks: build it with --heldout")
    conditions: dict[str, str | int] = {
        "dataset": dataset.folder.name,
        "training tasks": len(learned.train),
        "held-out tasks": len(dataset.heldout),
    }
    if training is not None:
        conditions["learned from"] = f"{learned.folder.parent.name}/{learned.folder.name}"
    return dataset, learned, conditions
