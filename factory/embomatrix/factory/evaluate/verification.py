"""Second verification of admitted tasks by processes that took no part in admitting them.

Two processes without shared state judge each task. Both find and execute a plan; their traces must be equal to the bit.
Optionally a robot also executes the dataset's plan in stepped physics.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.factory.admission import SEED, PlanFailure, TaskRefusal, admit, oracle_plan, plan_failure
from embomatrix.factory.evaluate.scripts import by_bundle, in_processes
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.task_import.batch import max_held_share
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.executor import Simulator
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset, TaskRecord

SUCCESS: Final = ""
"""Empty sentence of a task without an objection."""
GOAL_PERCENT: Final = 100.0
PHYSICAL_GOAL_PERCENT: Final = 98.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """Result of one process: an objection in cached mode, "" for none, and a failure in physics if ``in_physics``.

    ``digest`` covers every pose and state after every step of the plan. ``agrees`` means that the plan is the dataset's.
    """

    task: str
    cached: str
    digest: str
    agrees: bool
    in_physics: bool = False
    physical: PlanFailure | None = None


def sampled(records: Sequence[TaskRecord], most: int | None, seed: int) -> list[TaskRecord]:
    """Draw up to ``most`` records with a seed and return them in the order of the dataset; None returns all."""
    if most is None or most >= len(records):
        return list(records)
    chosen = np.random.default_rng((seed, len(records))).permutation(len(records))[:most]
    return [records[int(at)] for at in sorted(chosen)]


def verify_again(
    folder: Path,
    records: Sequence[TaskRecord],
    *,
    physical: bool,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[Judgement]:
    """Judge records of a dataset twice and call ``progress`` with the number of judgements so far.

    Raises DatasetError if a bundle or a plan can't be read or a process dies.
    """
    groups = by_bundle(records).values()
    found: list[dict[str, Judgement]] = []
    done = 0
    # A new pool for each round: no process of the second round shares state with the first.
    for in_physics in (False, physical):
        judgements: dict[str, Judgement] = {}
        judge = partial(_judge_bundle, folder, physical=in_physics)
        for group in in_processes(judge, groups, jobs=jobs, doing="verifies tasks"):
            judgements |= {each.task: each for each in group}
            done += len(group)
            progress(done)
        found.append(judgements)
    first, second = found
    return [compared(first[task], second[task]) for task in (record.task.task_id for record in records)]


def compared(first: Judgement, second: Judgement) -> Judgement:
    """Combine two judgements of one task. The result agrees if both agree with the dataset and with each other."""
    same = (first.cached, first.digest) == (second.cached, second.digest)
    agrees = same and first.agrees and second.agrees
    return replace(second, cached=first.cached or second.cached, agrees=agrees)


def _judge_bundle(folder: Path, records: Sequence[TaskRecord], *, physical: bool) -> list[Judgement]:
    """Judge tasks of one bundle."""
    bundle = Dataset(folder, ()).read_bundle(records[0].bundle_digest)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        judgements = [_cached(simulator, record) for record in records]
    if not physical:
        return judgements
    return [
        replace(each, in_physics=True, physical=_physical(bundle, record))
        for each, record in zip(judgements, records, strict=True)
    ]


def _cached(simulator: Simulator, record: TaskRecord) -> Judgement:
    """Judge a task as admission does and execute the plan found."""
    verdict = admit(simulator, record.task, find_plan, most_held=max_held_share(record.task))
    if isinstance(verdict, TaskRefusal):
        return Judgement(record.task.task_id, f"{verdict.reason}: {verdict.sentence}", "", agrees=False)
    trace = simulator.execute(record.task, verdict, SEED)
    same = plan_to_json(verdict) == [dict(call) for call in record.oracle]
    return Judgement(record.task.task_id, SUCCESS, trace.digest, same)


def _physical(bundle: Bundle, record: TaskRecord) -> PlanFailure | None:
    """Execute the dataset's plan with a robot in physics; return the failure, None if it reaches the goal."""
    plan = oracle_plan(record)
    with contextlib.closing(physical_simulator(bundle)) as simulator:
        return plan_failure(simulator, record.task, plan)


def evaluation_of(verdicts: Sequence[Judgement], conditions: Mapping[str, Any]) -> EvaluationFigures:
    """Return shares of the tasks in percent, and the reasons why plans failed in physics, most frequent first."""
    physical = [verdict.physical for verdict in verdicts if verdict.in_physics]
    figures = [
        _figure("oracle_cached", [not verdict.cached for verdict in verdicts], GOAL_PERCENT),
        _figure("reverified_bit_equal", [verdict.agrees for verdict in verdicts], GOAL_PERCENT),
    ]
    if physical:
        figures.append(
            _figure("oracle_physical", [failure is None for failure in physical], PHYSICAL_GOAL_PERCENT)
        )
    reasons = Counter(failure.reason for failure in physical if failure is not None)
    counts = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    notes = (f"Plans that failed in physics: {counts}.",) if counts else ()
    return EvaluationFigures("verification", conditions, tuple(figures), notes)


def objections(verdicts: Sequence[Judgement]) -> Iterator[str]:
    """Yield a line for each objection to a task."""
    for verdict in verdicts:
        if verdict.cached:
            yield f"{verdict.task}: {verdict.cached}"
        elif not verdict.agrees:
            yield f"{verdict.task}: two processes, or one of them and the dataset, differ in plan or trace"
        if verdict.physical:
            yield f"{verdict.task}, in physics: {verdict.physical}"


def _figure(name: str, held: Sequence[bool], goal: float) -> Figure:
    return Figure(name, 100 * sum(held) / len(held), "%", Better.HIGHER, len(held), goal)
