"""The rows of the ablation that have no cluster: a process that loads the scene for every rollout it executes."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.bench.engine.subject import frozen_heap
from embomatrix.reward.hierarchy import score
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.simulation import load_simulator
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE
from embomatrix.world.bundle import decode_bundle

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.rpc.wire.values import Rollout
    from embomatrix.world.bundle import Bundle

    MakeSimulator = Callable[[Bundle], Simulator]


@dataclass(frozen=True, slots=True)
class NaiveRollout:
    """What a rollout in physical mode took."""

    rollout: Rollout
    seconds: float
    """From the bundle's bytes to the reward, on the clock."""
    steps: int
    """Of 1/240 s, that went by in its world."""


def naive(rollouts: Sequence[Rollout], bundles: Mapping[str, bytes]) -> list[NaiveRollout]:
    """Each rollout loaded and executed in physical mode: our loader, and what rests sleeps."""
    taken = []
    for rollout in rollouts:
        actors: list[PhysicalActor] = []

        def make(bundle: Bundle, actors: list[PhysicalActor] = actors) -> Simulator:
            actors.append(PhysicalActor(bundle))
            return load_simulator(bundle, actor=actors[0])

        seconds = _seconds(rollout, bundles[rollout.bundle_digest], make)
        taken.append(NaiveRollout(rollout, seconds, actors[0].dynamic.steps))
    return taken


def cached_s(rollouts: Sequence[Rollout], bundles: Mapping[str, bytes]) -> list[float]:
    """Seconds of each rollout, loaded and executed in cached mode, in physics clients that stay connected."""
    with contextlib.closing(ClientPool(spare=CLIENTS_PER_SCENE)) as clients:

        def make(bundle: Bundle) -> Simulator:
            return Simulator(bundle, BulletEngine(bundle.scene, clients, PreparedScene.of(bundle)))

        return [_seconds(rollout, bundles[rollout.bundle_digest], make) for rollout in rollouts]


def _seconds(rollout: Rollout, data: bytes, make: MakeSimulator) -> float:
    """From the bundle's bytes to the reward, on the clock."""
    with frozen_heap():
        started_s = time.perf_counter()
        bundle = decode_bundle(data, digest=rollout.bundle_digest)
        with contextlib.closing(make(bundle)) as simulator:
            task = bundle.tasks[rollout.task_id]
            trace = simulator.execute(task, rollout.plan, rollout.seed)
            score(task, trace.touched, simulator.facts)
            return time.perf_counter() - started_s
