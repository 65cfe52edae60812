"""Runs of the scene evaluation: scene after scene, in this process or in several; stopped at any time and taken up again."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from embomatrix.factory.evaluate.scenes import LayoutMethod, LayoutOutcome, SceneTask, evaluation_of, judge
from embomatrix.factory.pipeline.store import ResumableLog
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.process_pool import process_pool

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from embomatrix.factory.metrics.figures import EvaluationFigures

    Trial = tuple[SceneTask, LayoutMethod]


class OutcomeLog(ResumableLog[LayoutOutcome]):
    """Outcomes of trials; their seed decides them."""

    @staticmethod
    def open(path: Path, seed: int) -> OutcomeLog:
        """Start a log or take one up. A last line that was cut short is dropped. Raises EvaluationError, OSError."""
        log = OutcomeLog(path)
        log.resume({"seed": seed}, _outcome)
        return log


def _outcome(value: dict[str, Any]) -> LayoutOutcome:
    told = {**value, "method": LayoutMethod(value["method"]), "planar_s": tuple(value["planar_s"])}
    return LayoutOutcome(**told)


def evaluate_scenes(
    tasks: Sequence[SceneTask],
    methods: Sequence[LayoutMethod],
    seed: int,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
    log: OutcomeLog | None = None,
) -> tuple[EvaluationFigures, list[LayoutOutcome]]:
    """Every task by every method; ``progress`` hears how many trials are done. Equal arguments, equal outcomes.

    Trials that the ``log`` holds are not made again; the others are added to it as they come.
    """
    log = log if log is not None else OutcomeLog()
    trials = [(task, method) for task in tasks for method in methods]
    known = {(each.task, each.scene, each.method) for each in log.outcomes}
    by_scene: defaultdict[str, list[Trial]] = defaultdict(list)
    for task, method in trials:
        if (task.source.name, task.scene, method) not in known:
            by_scene[task.scene].append((task, method))
    progress(len(trials) - sum(map(len, by_scene.values())))
    with contextlib.ExitStack() as stack:
        for outcome in _made([(group, seed) for group in by_scene.values()], jobs, stack):
            log.add(outcome)
            progress(len(log.outcomes))
    found = {(each.task, each.scene, each.method): each for each in log.outcomes}
    outcomes = [found[task.source.name, task.scene, method] for task, method in trials]
    conditions = {
        "tasks": len(tasks),
        "base scenes": len({task.scene for task in tasks}),
        "seed": seed,
        "methods": ", ".join(methods),
        "time": "CPU seconds of one task from BDDL text to scene, base scene built before, execution after",
    }
    return evaluation_of(outcomes, conditions), outcomes


def _made(
    orders: Sequence[tuple[Sequence[Trial], int]], jobs: int, stack: contextlib.ExitStack
) -> Iterator[LayoutOutcome]:
    """Outcomes, one by one in this process, scene by scene from several."""
    if jobs == 1:
        for order in orders:
            yield from _judged(order)
        return
    pool = stack.enter_context(process_pool(jobs))
    for group in pool.map(_all_judged, orders):
        yield from group


def _all_judged(order: tuple[Sequence[Trial], int]) -> list[LayoutOutcome]:
    return list(_judged(order))


def _judged(order: tuple[Sequence[Trial], int]) -> Iterator[LayoutOutcome]:
    trials, seed = order
    base = build_base_scene(trials[0][0].scene)
    with contextlib.closing(PlacementLibrary()) as library:
        for task, method in trials:
            yield judge(task, method, base, library, seed=seed)
