"""The real simulation: bundles loaded into the physics engine, plans executed and scored there.

The daemon starts it as ``python -m embomatrix.worker.slots.physics FD PARENT``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.reward.hierarchy import score
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.outcome import completed_to_proto
from embomatrix.rpc.wire.rollout import rollout_from_proto, rollout_to_proto
from embomatrix.rpc.wire.values import Completed, Rollout, Timings
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.worker.slots.rehearsal import PLANS, REHEARSAL, TIMES, rehearsal_bundle
from embomatrix.worker.slots.slot_program import BundleCorruptError, run_program
from embomatrix.world.bundle import decode_bundle, encode_bundle, read_bundle
from embomatrix.world.inflation import BundleError, bundle_digest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from embomatrix.world.bundle import Bundle

CLIENTS_PER_SCENE: Final = 2
"""An engine holds its scene in one client and settles objects in another."""


class UnknownTaskError(Exception):
    """A rollout names a task that its bundle lacks."""


class Physics:
    """Loads bundles with PyBullet."""

    def prepare(self) -> None:
        """Import the engine and connect the clients that every scene needs; raises EngineError where it is missing."""
        self._clients = ClientPool(spare=CLIENTS_PER_SCENE)
        self._rehearse()

    def load(self, path: Path, digest: str) -> PhysicsScene:
        try:
            bundle = read_bundle(path, digest=digest)
        except BundleError as error:
            raise BundleCorruptError(str(error)) from error
        return PhysicsScene(bundle, self._clients)

    def _rehearse(self) -> None:
        """Load and execute something small, and forget it: see ``rehearsal``."""
        data = encode_bundle(rehearsal_bundle())
        for _ in range(TIMES):
            scene = PhysicsScene(decode_bundle(data), self._clients)
            for plan in PLANS:
                rollout = Rollout(REHEARSAL, REHEARSAL, bundle_digest(data), REHEARSAL, plan, 0)
                completed = scene.execute(rollout_from_proto(rollout_to_proto(rollout)))
                completed_to_proto(completed).SerializeToString()
            scene.close()


class PhysicsScene:
    """A bundle's scene in the engine. Every execution starts from the scene as it was loaded."""

    def __init__(self, bundle: Bundle, clients: ClientPool) -> None:
        self._tasks = bundle.tasks
        self._engine = BulletEngine(bundle.scene, clients, PreparedScene.of(bundle))
        self._simulator = Simulator(bundle, self._engine)
        for task in list(bundle.tasks.values())[:1]:
            # An empty plan: what the simulator makes when it is first needed is made before the slots are forked.
            self._simulator.execute(task, (), 0)
            score(task, frozenset(), self._simulator.facts)

    def complete(self) -> Iterator[None]:
        """Make what executions would make when they first need it."""
        navigator = self._simulator.world.navigator
        navigator.reachable(navigator.start, navigator.start)
        yield
        yield from self._engine.warm_up()
        yield from self._simulator.warm_up()

    def close(self) -> None:
        """Give the clients back. The scene can't be used afterwards."""
        self._simulator.close()

    def execute(
        self,
        rollout: Rollout,
        on_step: Callable[[int], None] = lambda _: None,
        reward: RewardSettings = PAPER,
    ) -> Completed:
        task = self._tasks.get(rollout.task_id)
        if task is None:
            raise UnknownTaskError(
                f"bundle {rollout.bundle_digest} has no task {rollout.task_id!r}: "
                f"it has {len(self._tasks)}; submit the digest of the task's own bundle"
            )
        trace = self._simulator.execute(task, rollout.plan, rollout.seed, on_step)
        return Completed(
            reward=score(task, trace.touched, self._simulator.facts, reward),
            steps=trace.steps,
            final=trace.final,
            trace_digest=trace.digest,
            worker_id="",
            timings=Timings(),
            warm=True,
        )


if __name__ == "__main__":
    run_program(Physics())
