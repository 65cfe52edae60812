"""`bench engine`: what loading, executing and resetting cost on one core, for a pinned workload in furnished scenes.

Durations are CPU time of the one thread that does the work, so that a busy machine changes them little. Every plan is
executed once: nothing is measured that a rollout before it has computed. The scene has waited for its first rollout as long as
a worker's does that is announced: it has made what executions would make first.
"""

from __future__ import annotations

import contextlib
import gc
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.engine.slots import SlotSample, measure_slots
from embomatrix.bench.engine.subject import CountingEngine, frozen_heap
from embomatrix.bench.engine.workload import SIZES
from embomatrix.bench.report.figures import BenchError, quantile
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import score
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.placing.pose_cache import PlacementLibrary, analyse_scene
from embomatrix.sim.zygote import resident_mb
from embomatrix.skills.syntax import Skill
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import DatasetError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.bench.engine.workload import Execution, SceneWork, Workload
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.dataset import Dataset

LOAD_GOAL_MS: Final = 25.0
RESPAWN_GOAL_MS: Final = 10.0
RESET_GOAL_MS: Final = 0.1
ROLLOUT_GOAL_MS: Final = 1.5
ROLLOUT_P99_GOAL_MS: Final = 10.0
RATE_GOAL: Final = 700.0
SLOT_GOAL_MB: Final = 10.0
LEAK_GOAL_KB: Final = 1.0
"""Growth below this is what the allocator's bookkeeping moves; the goal itself is none."""
POSES_GOAL: Final = 1000.0
ANALYSIS_GOAL_S: Final = 20.0
"""Goals for one core and furnished scenes of about 300 bodies."""
SAMPLE_EVERY: Final = 20
"""Cycles between two readings of the memory in use."""


@dataclass(frozen=True, slots=True)
class EngineSamples:
    """Seconds of single measurements in one process."""

    rollout_s: list[float] = field(default_factory=list)
    reset_s: list[float] = field(default_factory=list)
    settled_places: list[bool] = field(default_factory=list)
    calls_ok: list[bool] = field(default_factory=list)


def bench_engine(
    dataset: Dataset, workload: Workload, cycles: int, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """All figures. Raises BenchError when the dataset is not the one that the workload was written for."""
    data = check_scenes(dataset, workload)
    sizes = [size for size in SIZES if workload.of_size(size)]
    by_size = {}
    for size in sizes:
        on_step(f"executing in scenes of about {size} bodies")
        samples = EngineSamples()
        for scene in workload.of_size(size):
            _measure_rollouts(scene, data[scene.bundle_digest], samples)
        slots = measure_slots([(scene, data[scene.bundle_digest]) for scene in workload.of_size(size)])
        by_size[size] = (samples, slots)
    first = workload.main[0]
    bundle = decode_bundle(data[first.bundle_digest])
    on_step(f"{cycles} cycles of loading and resetting")
    leak_kb = _leak_kb(data[first.bundle_digest], first, cycles)
    on_step("analysing a scene")
    figures = [*_main_figures(*by_size[workload.bodies]), _leak_figure(leak_kb, cycles), *_analysis(bundle)]
    for size in sizes:
        figures += _size_figures(size, *by_size[size])
    return tuple(figures)


def check_scenes(dataset: Dataset, workload: Workload) -> dict[str, bytes]:
    """The bundles of the workload's scenes by digest. Raises BenchError when the dataset lacks one."""
    if not workload.main:
        raise BenchError(f"the workload has no scene of about {workload.bodies} bodies: write it anew")
    return {scene.bundle_digest: _bundle_bytes(dataset, scene) for scene in workload.scenes}


def _bundle_bytes(dataset: Dataset, scene: SceneWork) -> bytes:
    try:
        return dataset.bundle_bytes(scene.bundle_digest)
    except DatasetError as error:
        raise BenchError(
            f"the dataset in {dataset.folder} lacks scene {scene.scene_id!r} as the workload knows it ({scene.bundle_digest}): "
            "build it with the seed and the scenes that docs/benchmarks.md names, or write a workload for this dataset with "
            f"'embomatrix bench workload --dataset={dataset.folder}' and give it with --workload"
        ) from error


def _measure_rollouts(scene: SceneWork, data: bytes, samples: EngineSamples) -> None:
    bundle = decode_bundle(data, digest=scene.bundle_digest)
    clients = ClientPool(spare=CLIENTS_PER_SCENE)
    engine = CountingEngine(bundle.scene, clients, PreparedScene.of(bundle))
    simulator = Simulator(bundle, engine)
    try:
        with frozen_heap():
            task = next(iter(bundle.tasks.values()))
            # What is made when it is first needed, a worker makes before it forks slots.
            simulator.execute(task, (), 0)
            score(task, frozenset(), simulator.facts)
            for _ in (*engine.warm_up(), *simulator.warm_up()):
                pass
            for execution in scene.executions:
                task = bundle.tasks[execution.task_id]
                with _cpu_timed(samples.rollout_s):
                    trace = simulator.execute(task, execution.plan, execution.seed)
                    score(task, trace.touched, simulator.facts)
                samples.calls_ok.extend(step.ok for step in trace.steps)
                samples.calls_ok.extend([False] * (len(execution.plan) - len(trace.steps)))
            for execution in scene.executions:
                _count_settles(simulator, engine, bundle, execution, samples)
    finally:
        simulator.close()
        clients.close()


def _count_settles(
    simulator: Simulator, engine: CountingEngine, bundle: Bundle, execution: Execution, samples: EngineSamples
) -> None:
    """Once more, call by call; then what a reset costs after all of it."""
    task = bundle.tasks[execution.task_id]
    simulator.reset(task, execution.seed)
    for call in execution.plan:
        before = engine.settles
        if not simulator.run_step(call).ok:
            break
        if call.skill is Skill.PLACE:
            samples.settled_places.append(engine.settles > before)
    with _cpu_timed(samples.reset_s):
        simulator.reset(task, execution.seed)


def _leak_kb(data: bytes, scene: SceneWork, cycles: int) -> float:
    """Growth of this process for each cycle of decoding, loading, executing, resetting and closing.

    It is the slope of a line through the resident memory of the second half.
    """
    clients = ClientPool(spare=CLIENTS_PER_SCENE)
    sizes_kb: list[float] = []
    for cycle in range(cycles):
        bundle = decode_bundle(data)
        execution = scene.executions[cycle % len(scene.executions)]
        with contextlib.closing(
            Simulator(bundle, BulletEngine(bundle.scene, clients, PreparedScene.of(bundle)))
        ) as simulator:
            simulator.execute(bundle.tasks[execution.task_id], execution.plan, execution.seed)
            simulator.reset(bundle.tasks[execution.task_id], execution.seed)
        if cycle % SAMPLE_EVERY == SAMPLE_EVERY - 1:
            del bundle, simulator
            gc.collect()
            sizes_kb.append(resident_mb() * 1024)
    clients.close()
    half = np.array(sizes_kb[len(sizes_kb) // 2 :])
    if len(half) < 2:
        raise BenchError(f"{cycles} cycles are too few to see growth: expected {4 * SAMPLE_EVERY} or more")
    return float(np.polyfit(np.arange(len(half)) * SAMPLE_EVERY, half, 1)[0])


def _analysis(bundle: Bundle) -> Iterator[Figure]:
    """Poses of every footprint on, in and under all that can hold something, and standing poses for all objects."""
    seconds: list[float] = []
    with (
        contextlib.closing(PlacementLibrary()) as library,
        contextlib.closing(BulletEngine(bundle.scene)) as engine,
        _cpu_timed(seconds),
    ):
        poses = analyse_scene(bundle.scene, seed=0, engine=engine, library=library)
    count = sum(len(found) for found in poses.placements.values())
    rate = count / seconds[0]
    yield Figure("poses_per_s", rate, "1/s", Better.HIGHER, count, POSES_GOAL)
    yield Figure("analysis_s", seconds[0], "s", Better.LOWER, 1, ANALYSIS_GOAL_S)


def _main_figures(samples: EngineSamples, slots: SlotSample) -> Iterator[Figure]:
    yield _quantile_ms("cold_load_ms", slots.load_s, 0.5, LOAD_GOAL_MS)
    yield _quantile_ms("slot_respawn_ms", slots.respawn_s, 0.5, RESPAWN_GOAL_MS)
    yield _quantile_ms("reset_ms", samples.reset_s, 0.5, RESET_GOAL_MS)
    yield _quantile_ms("rollout_p50_ms", samples.rollout_s, 0.5, ROLLOUT_GOAL_MS)
    yield _quantile_ms("rollout_p99_ms", samples.rollout_s, 0.99, ROLLOUT_P99_GOAL_MS)
    rate = len(slots.execute_s) / sum(slots.execute_s)
    yield Figure("rollouts_per_s", rate, "1/s", Better.HIGHER, len(slots.execute_s), RATE_GOAL)
    private_mb = quantile(slots.private_mb, 0.5)
    yield Figure("private_mb_per_slot", private_mb, "MB", Better.LOWER, len(slots.private_mb), SLOT_GOAL_MB)
    for name, flags in (
        ("places_settled_live", samples.settled_places),
        ("calls_succeeded", samples.calls_ok),
    ):
        yield Figure(name, sum(flags) / max(1, len(flags)), "share", Better.HIGHER, max(1, len(flags)))


def _leak_figure(leak_kb: float, cycles: int) -> Figure:
    # A fitted slope of a level line is a little above or below nothing.
    return Figure("leak_kb_per_cycle", max(0.0, leak_kb), "kB", Better.LOWER, cycles, LEAK_GOAL_KB)


def _size_figures(size: int, samples: EngineSamples, slots: SlotSample) -> Iterator[Figure]:
    """Cost against size, without goals: those are for the main size."""
    at = f"at {size} bodies"
    yield _quantile_ms(f"cold_load_ms {at}", slots.load_s, 0.5)
    yield _quantile_ms(f"slot_respawn_ms {at}", slots.respawn_s, 0.5)
    yield _quantile_ms(f"reset_ms {at}", samples.reset_s, 0.5)
    yield _quantile_ms(f"rollout_p50_ms {at}", samples.rollout_s, 0.5)
    yield _quantile_ms(f"rollout_p99_ms {at}", samples.rollout_s, 0.99)
    private_mb = quantile(slots.private_mb, 0.5)
    yield Figure(f"private_mb_per_slot {at}", private_mb, "MB", Better.LOWER, len(slots.private_mb))


def _quantile_ms(name: str, seconds: Sequence[float], share: float, goal: float | None = None) -> Figure:
    return Figure(name, quantile(seconds, share) * 1e3, "ms", Better.LOWER, len(seconds), goal)


@contextlib.contextmanager
def _cpu_timed(seconds: list[float]) -> Iterator[None]:
    started_s = time.thread_time()
    yield
    seconds.append(time.thread_time() - started_s)
