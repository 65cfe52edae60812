"""Admitted tasks judged again, by processes that had no part in admitting them.

Each task is judged in two processes that share nothing: both find a plan anew and execute it, and both must come to the same
traces, to the bit. Where asked for, a robot carries the dataset's own plan out in stepped physics as well.
"""

from __future__ import annotations

import contextlib
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.admission import SEED, Admitted, admit, plan_failure
from embomatrix.factory.task_import.batch import max_held_share
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.process_pool import process_pool
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_from_json, plan_to_json
from embomatrix.world.dataset import Dataset, DatasetError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from embomatrix.factory.admission import PlanFailure
    from embomatrix.sim.executor import Simulator
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.dataset import TaskRecord

SUCCESS: Final = ""
"""Instead of a sentence against a task."""


@dataclass(frozen=True, slots=True)
class Look:
    """Findings of one process: an objection in cached mode, "" for none, and a failure in physics if ``in_physics``.

    ``digest`` covers every pose and state after every step of the plan found. ``same_plan``: it is the dataset's own plan.
    """

    task: str
    cached: str
    digest: str
    same_plan: bool
    in_physics: bool = False
    physical: PlanFailure | None = None


@dataclass(frozen=True, slots=True)
class VerificationOutcome:
    """What became of a task: the sentences of both modes, and whether two processes agree with each other and the dataset."""

    task: str
    cached: str
    equal: bool
    in_physics: bool
    physical: PlanFailure | None


@dataclass(frozen=True, slots=True)
class _Order:
    folder: Path
    bundle_digest: str
    tasks: tuple[str, ...]
    physical: bool


def sampled(records: Sequence[TaskRecord], most: int | None, seed: int) -> list[TaskRecord]:
    """At most so many records, drawn by the seed, in the order of the dataset; all of them without a number."""
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
) -> list[VerificationOutcome]:
    """Judge records of a dataset, in their order; ``progress`` hears how many looks are done, two for each task.

    Raises DatasetError where a bundle can't be read, or a process dies.
    """
    by_bundle: dict[str, list[str]] = {}
    for record in records:
        by_bundle.setdefault(record.bundle_digest, []).append(record.task.task_id)
    found: list[dict[str, Look]] = []
    done = 0
    # A pool each: no process of the second look has seen what the first one did.
    for in_physics in (False, physical):
        looks: dict[str, Look] = {}
        orders = [_Order(folder, digest, tuple(tasks), in_physics) for digest, tasks in by_bundle.items()]
        for group in _looked(orders, jobs):
            looks |= {look.task: look for look in group}
            done += len(group)
            progress(done)
        found.append(looks)
    first, second = found
    return [verdict_of(first[task], second[task]) for task in (record.task.task_id for record in records)]


def verdict_of(first: Look, second: Look) -> VerificationOutcome:
    """What two looks at one task come to."""
    same = (first.cached, first.digest) == (second.cached, second.digest)
    equal = same and first.same_plan and second.same_plan
    return VerificationOutcome(
        first.task, first.cached or second.cached, equal, second.in_physics, second.physical
    )


def _looked(orders: Sequence[_Order], jobs: int) -> Iterator[list[Look]]:
    try:
        with process_pool(jobs) as pool:
            yield from pool.map(_look_at, orders)
    except BrokenProcessPool as error:
        raise DatasetError(
            "a process that verifies tasks died, perhaps for want of memory: call the command again, with fewer --jobs"
        ) from error


def _look_at(order: _Order) -> list[Look]:
    """All looks at the tasks of one bundle."""
    dataset = Dataset.load(order.folder)
    bundle = dataset.read_bundle(order.bundle_digest)
    records = [dataset.find(task) for task in order.tasks]
    with contextlib.closing(load_simulator(bundle)) as stage:
        looks = [_cached(stage, record) for record in records]
    if not order.physical:
        return looks
    return [
        replace(look, in_physics=True, physical=_physical(bundle, record))
        for look, record in zip(looks, records, strict=True)
    ]


def _cached(stage: Simulator, record: TaskRecord) -> Look:
    """Judge a task as admission does, and execute the plan that is found."""
    verdict = admit(stage, record.task, find_plan, most_held=max_held_share(record.task))
    if not isinstance(verdict, Admitted):
        return Look(record.task.task_id, f"{verdict.reason}: {verdict.sentence}", "", same_plan=False)
    trace = stage.execute(record.task, verdict.plan, SEED)
    same = plan_to_json(verdict.plan) == [dict(call) for call in record.oracle]
    return Look(record.task.task_id, SUCCESS, trace.digest, same)


def _physical(bundle: Bundle, record: TaskRecord) -> PlanFailure | None:
    """Return the failure of the dataset's plan in stepped physics, None if it reaches the goal."""
    plan = plan_from_json(list(record.oracle), record.task.profile)
    with contextlib.closing(physical_simulator(bundle)) as stage:
        return plan_failure(stage, record.task, plan)
