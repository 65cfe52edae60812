"""`bench rollout`: what a scene and a rollout cost in one process, without the cluster around them."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.bench.engine.subject import CountingEngine, frozen_heap
from embomatrix.bench.report.figures import quantile, quantile_figure
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import score
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.skills.syntax import Skill
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE
from embomatrix.world.bundle import decode_bundle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.bench.engine.scenes import BenchScene, Demonstration
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.task import Task

BUILD_GOAL_MS: Final = 15.0
READY_GOAL_MS: Final = 60.0
"""Decoding, building and deriving: all that stands between a fetched bundle and its first rollout."""
ROLLOUT_GOAL_MS: Final = 8.0
RATE_GOAL: Final = 500.0
RESET_GOAL_US: Final = 100.0
SKILL_GOAL_US: Final = 200.0
SETTLED_PLACE_GOAL_US: Final = 3000.0
"""Goals for one core and scenes of up to 300 bodies, set from what the physics engine alone needs."""
SEED: Final = 0


@dataclass(frozen=True, slots=True)
class RolloutTimings:
    """Seconds of every single measurement, and how often an oracle plan reached its goal."""

    decode_s: list[float] = field(default_factory=list)
    build_s: list[float] = field(default_factory=list)
    """The engine alone, in clients that are connected for it."""
    build_connected_s: list[float] = field(default_factory=list)
    """The engine alone, in clients that were connected before, as a worker's are."""
    ready_s: list[float] = field(default_factory=list)
    """Decoding, building in connected clients, and what the simulator derives."""
    first_s: list[float] = field(default_factory=list)
    cold_over_warm: list[float] = field(default_factory=list)
    rollout_s: list[float] = field(default_factory=list)
    reset_s: list[float] = field(default_factory=list)
    score_s: list[float] = field(default_factory=list)
    skill_s: dict[Skill, list[float]] = field(default_factory=dict)
    verified_place_s: list[float] = field(default_factory=list)
    settled_place_s: list[float] = field(default_factory=list)
    reached: list[bool] = field(default_factory=list)


def bench_rollout(
    scenes: Sequence[BenchScene], repeats: int, on_scene: Callable[[int], None]
) -> tuple[Figure, ...]:
    """Execute every oracle plan ``repeats`` times in each scene. ``on_scene`` hears how many scenes are done.

    Raises BundleError or EngineError when a scene can't be loaded.
    """
    samples = RolloutTimings()
    wall_s, core_s = time.perf_counter(), time.process_time()
    for number, scene in enumerate(scenes, start=1):
        _measure_scene(scene, repeats, samples)
        on_scene(number)
    share = (time.process_time() - core_s) / (time.perf_counter() - wall_s)
    on_core = Figure("time that the process had a core", share, "share", Better.HIGHER, 1)
    return (*_figures(samples), on_core)


def _measure_scene(scene: BenchScene, repeats: int, samples: RolloutTimings) -> None:
    started_s = time.perf_counter()
    bundle = decode_bundle(scene.data, digest=scene.bundle_digest)
    decode_s = time.perf_counter() - started_s
    samples.decode_s.append(decode_s)
    with _timed(samples.build_s):
        engine = BulletEngine(bundle.scene)
    engine.close()
    clients = ClientPool(spare=CLIENTS_PER_SCENE)
    started_s = time.perf_counter()
    counting = CountingEngine(bundle.scene, clients, PreparedScene.of(bundle))
    samples.build_connected_s.append(time.perf_counter() - started_s)
    simulator = Simulator(bundle, counting)
    ready_s = decode_s + time.perf_counter() - started_s
    samples.ready_s.append(ready_s)
    try:
        with frozen_heap():
            _measure_first(simulator, bundle, scene.demonstrations[0], ready_s, samples)
            for demonstration in scene.demonstrations:
                _measure_task(simulator, counting, bundle, demonstration, repeats, samples)
    finally:
        simulator.close()
        clients.close()


def _measure_first(
    simulator: Simulator,
    bundle: Bundle,
    demonstration: Demonstration,
    ready_s: float,
    samples: RolloutTimings,
) -> None:
    """The first rollout of a scene beside the same rollout repeated: cold over warm."""
    task = bundle.tasks[demonstration.task_id]
    warm_s: list[float] = []
    for seconds in (samples.first_s, warm_s, warm_s, warm_s):
        with _timed(seconds):
            trace = simulator.execute(task, demonstration.plan, SEED)
            score(task, trace.touched, simulator.facts)
    samples.cold_over_warm.append((ready_s + samples.first_s[-1]) / quantile(warm_s, 0.5))


def _measure_task(
    simulator: Simulator,
    engine: CountingEngine,
    bundle: Bundle,
    demonstration: Demonstration,
    repeats: int,
    samples: RolloutTimings,
) -> None:
    task = bundle.tasks[demonstration.task_id]
    for repeat in range(repeats):
        started_s = time.perf_counter()
        trace = simulator.execute(task, demonstration.plan, SEED + repeat)
        executed_s = time.perf_counter()
        reward = score(task, trace.touched, simulator.facts)
        ended_s = time.perf_counter()
        samples.rollout_s.append(ended_s - started_s)
        samples.score_s.append(ended_s - executed_s)
        samples.reached.append(reward.success)
    _measure_steps(simulator, engine, task, demonstration, samples)


def _measure_steps(
    simulator: Simulator,
    engine: CountingEngine,
    task: Task,
    demonstration: Demonstration,
    samples: RolloutTimings,
) -> None:
    """The plan call by call, after a reset that has the last execution to undo."""
    with _timed(samples.reset_s):
        simulator.reset(task, SEED)
    for call in demonstration.plan:
        before = engine.settles
        started_s = time.perf_counter()
        step = simulator.run_step(call)
        seconds = time.perf_counter() - started_s
        if not step.ok:
            return
        samples.skill_s.setdefault(call.skill, []).append(seconds)
        if call.skill is Skill.PLACE:
            settled = engine.settles > before
            (samples.settled_place_s if settled else samples.verified_place_s).append(seconds)


def _figures(samples: RolloutTimings) -> tuple[Figure, ...]:
    rollout_s = sum(samples.rollout_s) / max(1, len(samples.rollout_s))
    cold_over_warm = quantile(samples.cold_over_warm, 0.5)
    return (
        quantile_figure("decode a bundle", samples.decode_s, 0.5, "ms"),
        quantile_figure("build a scene in new clients", samples.build_s, 0.5, "ms"),
        quantile_figure("build a scene", samples.build_connected_s, 0.5, "ms", BUILD_GOAL_MS),
        quantile_figure("bundle to ready simulator", samples.ready_s, 0.5, "ms", READY_GOAL_MS),
        quantile_figure("first rollout", samples.first_s, 0.5, "ms"),
        quantile_figure("rollout", samples.rollout_s, 0.5, "ms", ROLLOUT_GOAL_MS),
        quantile_figure("rollout", samples.rollout_s, 0.95, "ms"),
        Figure(
            "cold over warm (load and execute over execute)",
            cold_over_warm,
            "×",
            Better.LOWER,
            len(samples.cold_over_warm),
        ),
        Figure(
            "rollouts on one core",
            1.0 / rollout_s,
            "1/s",
            Better.HIGHER,
            len(samples.rollout_s),
            RATE_GOAL,
        ),
        quantile_figure("reset", samples.reset_s, 0.5, "µs", RESET_GOAL_US),
        quantile_figure("score a final state", samples.score_s, 0.5, "µs"),
        *_skill_figures(samples),
        Figure(
            "oracle plans that reach their goal",
            sum(samples.reached) / len(samples.reached),
            "share",
            Better.HIGHER,
            len(samples.reached),
            1.0,
        ),
    )


def _skill_figures(samples: RolloutTimings) -> Iterator[Figure]:
    """Skills in the order of the plan language; those that no plan uses have no figure."""
    for skill in Skill:
        seconds = samples.skill_s.get(skill)
        if seconds and skill is not Skill.PLACE:
            yield quantile_figure(f"skill {skill.value}", seconds, 0.5, "µs", SKILL_GOAL_US)
    for words, seconds, goal in (
        ("at a verified pose", samples.verified_place_s, SKILL_GOAL_US),
        ("with settling", samples.settled_place_s, SETTLED_PLACE_GOAL_US),
    ):
        if seconds:
            yield quantile_figure(f"skill place {words}", seconds, 0.5, "µs", goal)
    places = len(samples.verified_place_s) + len(samples.settled_place_s)
    if places:
        share = len(samples.settled_place_s) / places
        yield Figure("places that needed a settle", share, "share", Better.LOWER, places)


@contextlib.contextmanager
def _timed(seconds: list[float]) -> Iterator[None]:
    started_s = time.perf_counter()
    yield
    seconds.append(time.perf_counter() - started_s)
