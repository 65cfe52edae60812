"""Cost of returning to an earlier state, and memory of a full transition tree, in the scenes of the main size."""

from __future__ import annotations

import contextlib
import gc
import itertools
import random
import time
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import quantile
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import judge
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.transitions import NODES_KEPT, TransitionTree
from embomatrix.sim.zygote import private_mb
from embomatrix.world.bundle import Bundle, decode_bundle

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import SceneWork, Workload

RETURN_GOAL_US: Final = 100.0
TREE_GOAL_MB: Final = 16.0


def bench_marks(workload: Workload) -> tuple[Figure, ...]:
    """Measure the main scenes of the workload."""
    main = workload.main
    returns_s: list[float] = []
    sizes_mb: list[float] = []
    for scene in main.scenes:
        bundle = decode_bundle(main.bundles[scene.bundle_digest], digest=scene.bundle_digest)
        returns_s += _returns_s(scene, bundle)
        sizes_mb.append(_tree_mb(scene, bundle))
    count = len(returns_s)
    return (
        Figure("mark_return_us", quantile(returns_s, 0.5) * 1e6, "µs", Better.LOWER, count, RETURN_GOAL_US),
        Figure("mark_return_us, 99th percentile", quantile(returns_s, 0.99) * 1e6, "µs", Better.LOWER, count),
        Figure("tree_mb_per_slot", max(sizes_mb), "MB", Better.LOWER, len(sizes_mb), TREE_GOAL_MB),
    )


def _returns_s(scene: SceneWork, bundle: Bundle) -> list[float]:
    """Seconds of returns from the end of each plan to random states on its way."""
    rng = random.Random(0)
    seconds: list[float] = []
    with contextlib.closing(load_simulator(bundle)) as simulator:
        for execution in scene.executions:
            simulator.reset(bundle.tasks[execution.task_id], execution.seed)
            marks = [simulator.mark()]
            for call in execution.plan:
                simulator.run_step(call)
                marks.append(simulator.mark())
            for mark in rng.sample(marks, len(marks)):
                started_s = time.perf_counter()
                simulator.return_to(mark, execution.seed)
                seconds.append(time.perf_counter() - started_s)
                simulator.return_to(marks[-1], execution.seed)
    return seconds


def _tree_mb(scene: SceneWork, bundle: Bundle) -> float:
    """Private memory that a full tree adds to a simulator that has executed all plans."""
    with contextlib.closing(load_simulator(bundle)) as simulator:
        for execution in scene.executions:
            simulator.execute(bundle.tasks[execution.task_id], execution.plan, execution.seed)
        gc.collect()
        before_mb = private_mb()
        tree = TransitionTree(simulator, lambda task: judge(task, simulator.facts))
        for seed in itertools.count():
            for execution in scene.executions:
                tree.execute(bundle.tasks[execution.task_id], execution.plan, seed)
            if len(tree) >= NODES_KEPT:
                break
        gc.collect()
        return private_mb() - before_mb
