"""Runs of the scene evaluation: scene after scene, in this process or in several."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING

from embomatrix.factory.evaluate.scenes import Method, Outcome, SceneTask, evaluation_of, judge
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.sim.pose_cache import PlacementLibrary

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.factory.evaluate.figures import Evaluation


def evaluate_scenes(
    tasks: Sequence[SceneTask],
    methods: Sequence[Method],
    seed: int,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> tuple[Evaluation, list[Outcome]]:
    """Every task by every method; ``progress`` hears of the tasks that are done. Equal arguments, equal outcomes."""
    by_scene: defaultdict[str, list[SceneTask]] = defaultdict(list)
    for task in tasks:
        by_scene[task.scene].append(task)
    groups = [(group, tuple(methods), seed) for group in by_scene.values()]
    outcomes: list[Outcome] = []
    done = 0
    with contextlib.ExitStack() as stack:
        if jobs == 1:
            made: Iterator[list[Outcome]] = map(_judged, groups)
        else:
            spawn = multiprocessing.get_context("spawn")
            made = stack.enter_context(ProcessPoolExecutor(jobs, spawn)).map(_judged, groups)
        for (group, _, _), found in zip(groups, made, strict=True):
            outcomes += found
            done += len(group)
            progress(done)
    conditions = {
        "tasks": len(tasks),
        "base scenes": len(by_scene),
        "seed": seed,
        "methods": ", ".join(methods),
        "time": "CPU seconds of one task from BDDL text to scene, base scene built before, execution after",
    }
    return evaluation_of(outcomes, conditions), outcomes


def _judged(order: tuple[Sequence[SceneTask], Sequence[Method], int]) -> list[Outcome]:
    tasks, methods, seed = order
    base = build_base_scene(tasks[0].scene)
    with contextlib.closing(PlacementLibrary()) as library:
        return [judge(task, method, base, library, seed=seed) for task in tasks for method in methods]
