"""`bench engine`: cost of loading, executing and resetting on one core, for the pinned workload.

Durations are CPU time of the thread that does the work, so that other load on the machine changes them little. Every plan is
executed once, so no rollout reuses what an earlier one computed. Scenes have completed their deferred work first, as the
announced scenes of a worker have.
"""

import contextlib
import gc
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.bench.engine.slots import SlotSample, measure_slots
from embomatrix.bench.engine.workload import SIZES, Execution, SceneWork, Workload
from embomatrix.bench.report.figures import BenchError, quantile, quantile_figure
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import score
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.engine import NOTHING, SETTLE_STEPS, Settled
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.placing.pose_cache import PlacementLibrary, analyse_scene
from embomatrix.sim.zygote import resident_mb
from embomatrix.skills.syntax import Skill
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE
from embomatrix.world.bundle import Bundle, decode_bundle

GOALS: Final = {
    "cold_load_ms": 25.0,
    "slot_respawn_ms": 10.0,
    "reset_ms": 0.1,
    "rollout_p50_ms": 1.0,
    "rollout_p99_ms": 10.0,
    "private_mb_per_slot": 10.0,
}
RATE_GOAL: Final = 700.0
LEAK_GOAL_KB: Final = 1.0
"""The allocator's own bookkeeping moves less than this; the goal is no growth."""
POSES_GOAL: Final = 1000.0
ANALYSIS_GOAL_S: Final = 20.0
BUILD_GOAL_MS: Final = 15.0
READY_GOAL_MS: Final = 60.0
SKILL_GOAL_US: Final = 200.0
SETTLED_PLACE_GOAL_US: Final = 3000.0
"""Goals for one core and furnished scenes of about 300 bodies."""
SAMPLE_EVERY: Final = 20
"""Cycles between two readings of the resident memory."""
SETTLED: Final = "place with settling"
VERIFIED: Final = "place, verified pose"


@dataclass(frozen=True, slots=True)
class EngineSamples:
    """CPU seconds of single measurements in one process."""

    decode_s: list[float] = field(default_factory=list)
    build_s: list[float] = field(default_factory=list)
    """The engine alone, in physics clients that are connected already."""
    ready_s: list[float] = field(default_factory=list)
    """Decoding, building, and what the simulator derives."""
    rollout_s: list[float] = field(default_factory=list)
    reset_s: list[float] = field(default_factory=list)
    skill_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    calls_ok: list[bool] = field(default_factory=list)


class CountingEngine(BulletEngine):
    """Engine that counts how often it settled an object."""

    settles = 0

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        self.settles += 1
        return super().settle(name, steps, ignore)


def bench_engine(workload: Workload, cycles: int, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure everything; ``cycles`` of loading and resetting show whether memory grows. Raises BenchError."""
    sizes = [size for size in SIZES if workload.of_size(size).scenes]
    by_size = {}
    for size in sizes:
        on_step(f"executing in scenes of about {size} bodies")
        scenes = [(scene, workload.bundles[scene.bundle_digest]) for scene in workload.of_size(size).scenes]
        samples = EngineSamples()
        for scene, data in scenes:
            _measure_scene(scene, data, samples)
        by_size[size] = (samples, measure_slots(scenes))
    first = workload.main.scenes[0]
    data = workload.bundles[first.bundle_digest]
    on_step(f"{cycles} cycles of loading and resetting")
    growth_kb = growth_per_cycle_kb(data, first, cycles)
    on_step("analysing a scene")
    figures = [
        *_main_figures(*by_size[workload.bodies]),
        # The fitted slope of a level line is a little above or below 0.
        Figure("leak_kb_per_cycle", max(0.0, growth_kb), "kB", Better.LOWER, cycles, LEAK_GOAL_KB),
        *_analysis_figures(decode_bundle(data)),
        *_skill_figures(by_size[workload.bodies][0]),
    ]
    for size in sizes:
        figures += _size_figures(f" at {size} bodies", *by_size[size], {})
    return tuple(figures)


@contextlib.contextmanager
def frozen_heap() -> Iterator[None]:
    """Keep garbage collection out of what is measured, as the worker's slots do."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def _measure_scene(scene: SceneWork, data: bytes, samples: EngineSamples) -> None:
    with contextlib.closing(ClientPool(spare=CLIENTS_PER_SCENE)) as clients, contextlib.ExitStack() as opened:
        with _cpu_timed(samples.ready_s):
            with _cpu_timed(samples.decode_s):
                bundle = decode_bundle(data, digest=scene.bundle_digest)
            with _cpu_timed(samples.build_s):
                engine = CountingEngine(bundle.scene, clients, PreparedScene.of(bundle))
            simulator = opened.enter_context(contextlib.closing(Simulator(bundle, engine)))
        with frozen_heap():
            task = next(iter(bundle.tasks.values()))
            # A worker does this, too, before it forks slots.
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
                _measure_calls(simulator, engine, bundle, execution, samples)


def _measure_calls(
    simulator: Simulator, engine: CountingEngine, bundle: Bundle, execution: Execution, samples: EngineSamples
) -> None:
    """Execute the plan once more, call by call; then reset after all of it."""
    task = bundle.tasks[execution.task_id]
    simulator.reset(task, execution.seed)
    for call in execution.plan:
        before = engine.settles
        seconds: list[float] = []
        with _cpu_timed(seconds):
            step = simulator.run_step(call)
        if not step.ok:
            break
        name = SETTLED if engine.settles > before else VERIFIED
        samples.skill_s[name if call.skill is Skill.PLACE else call.skill.value] += seconds
    with _cpu_timed(samples.reset_s):
        simulator.reset(task, execution.seed)


def growth_per_cycle_kb(data: bytes, scene: SceneWork, cycles: int) -> float:
    """Growth of this process in each cycle of decoding, loading, executing, resetting and closing.

    The result is the slope of a line through the resident memory of the second half of the cycles.
    """
    clients = ClientPool(spare=CLIENTS_PER_SCENE)
    sizes_kb: list[float] = []
    for cycle in range(cycles):
        bundle = decode_bundle(data)
        execution = scene.executions[cycle % len(scene.executions)]
        engine = BulletEngine(bundle.scene, clients, PreparedScene.of(bundle))
        with contextlib.closing(Simulator(bundle, engine)) as simulator:
            simulator.execute(bundle.tasks[execution.task_id], execution.plan, execution.seed)
            simulator.reset(bundle.tasks[execution.task_id], execution.seed)
        if cycle % SAMPLE_EVERY == SAMPLE_EVERY - 1:
            del bundle, engine, simulator
            gc.collect()
            sizes_kb.append(resident_mb() * 1024)
    clients.close()
    half = np.array(sizes_kb[len(sizes_kb) // 2 :])
    if len(half) < 2:
        raise BenchError(f"{cycles} cycles are too few to see growth: expected {4 * SAMPLE_EVERY} or more")
    return float(np.polyfit(np.arange(len(half)) * SAMPLE_EVERY, half, 1)[0])


def _analysis_figures(bundle: Bundle) -> Iterator[Figure]:
    """Analyse a scene as the factory does: placement poses for every footprint, standing poses for all objects."""
    seconds: list[float] = []
    with (
        contextlib.closing(PlacementLibrary()) as library,
        contextlib.closing(BulletEngine(bundle.scene)) as engine,
        _cpu_timed(seconds),
    ):
        poses = analyse_scene(engine, library, seed=0)
    count = sum(len(found) for found in poses.placements.values())
    yield Figure("poses_per_s", count / seconds[0], "1/s", Better.HIGHER, count, POSES_GOAL)
    yield Figure("analysis_s", seconds[0], "s", Better.LOWER, 1, ANALYSIS_GOAL_S)


def _main_figures(samples: EngineSamples, slots: SlotSample) -> Iterator[Figure]:
    yield from _size_figures("", samples, slots, GOALS)
    rate = len(slots.execute_s) / sum(slots.execute_s)
    yield Figure("rollouts_per_s", rate, "1/s", Better.HIGHER, len(slots.execute_s), RATE_GOAL)
    settled, verified = len(samples.skill_s[SETTLED]), len(samples.skill_s[VERIFIED])
    places, calls = settled + verified, len(samples.calls_ok)
    yield Figure("places_settled_live", settled / max(1, places), "share", Better.LOWER, places)
    yield Figure("calls_succeeded", sum(samples.calls_ok) / max(1, calls), "share", Better.HIGHER, calls)


def _skill_figures(samples: EngineSamples) -> Iterator[Figure]:
    yield quantile_figure("decode a bundle", samples.decode_s, 0.5, "ms")
    yield quantile_figure("build a scene", samples.build_s, 0.5, "ms", BUILD_GOAL_MS)
    yield quantile_figure("bundle to ready simulator", samples.ready_s, 0.5, "ms", READY_GOAL_MS)
    for name, seconds in sorted(samples.skill_s.items()):
        if seconds:
            goal_us = SETTLED_PLACE_GOAL_US if name == SETTLED else SKILL_GOAL_US
            yield quantile_figure(f"skill {name}", seconds, 0.5, "µs", goal_us)


def _size_figures(
    at: str, samples: EngineSamples, slots: SlotSample, goals: Mapping[str, float]
) -> Iterator[Figure]:
    """Cost of scenes of one size; ``at`` names the size."""
    for name, seconds, share in (
        ("cold_load_ms", slots.load_s, 0.5),
        ("slot_respawn_ms", slots.respawn_s, 0.5),
        ("reset_ms", samples.reset_s, 0.5),
        ("rollout_p50_ms", samples.rollout_s, 0.5),
        ("rollout_p99_ms", samples.rollout_s, 0.99),
    ):
        value = quantile(seconds, share) * 1e3
        yield Figure(f"{name}{at}", value, "ms", Better.LOWER, len(seconds), goals.get(name))
    name, value = "private_mb_per_slot", quantile(slots.private_mb, 0.5)
    yield Figure(f"{name}{at}", value, "MB", Better.LOWER, len(slots.private_mb), goals.get(name))


@contextlib.contextmanager
def _cpu_timed(seconds: list[float]) -> Iterator[None]:
    started_s = time.thread_time()
    yield
    seconds.append(time.thread_time() - started_s)
