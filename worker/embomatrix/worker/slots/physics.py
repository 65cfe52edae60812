"""Simulation backend on the physics engine: it loads bundles, executes plans and scores them.

The daemon starts it as ``python -m embomatrix.worker.slots.physics FD PARENT``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.reward.hierarchy import judge, worth
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.outcome import completed_to_proto
from embomatrix.rpc.wire.rollout import rollout_from_proto, rollout_to_proto
from embomatrix.rpc.wire.values import Completed, Rollout, Timings
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.planner.oracle import advice_from_here
from embomatrix.sim.transitions import TransitionTree
from embomatrix.worker.slots.slot_program import BundleCorruptError, run_program
from embomatrix.worker.slots.warm_up import PLAN, TIMES, WARM_UP, warm_up_bundle
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle, read_bundle
from embomatrix.world.inflation import BundleError, bundle_digest

if TYPE_CHECKING:
    from embomatrix.skills.turns import Advice, EpisodePrefix
    from embomatrix.world.task import Task

CLIENTS_PER_SCENE: Final = 2
"""Physics clients of one engine: one holds the scene, another settles objects."""


class UnknownTaskError(Exception):
    """Rollout of a task that its bundle lacks."""


class Physics:
    """Backend that loads bundles with PyBullet."""

    def prepare(self) -> None:
        """Connect the physics clients and warm up. Raise EngineError if the engine is missing."""
        self._clients = ClientPool(spare=CLIENTS_PER_SCENE)
        self._warm_up()

    def load(self, path: Path, digest: str, *, sharing: bool) -> PhysicsScene:
        try:
            bundle = read_bundle(path, digest=digest)
        except BundleError as error:
            raise BundleCorruptError(str(error)) from error
        return PhysicsScene(bundle, self._clients, sharing=sharing)

    def _warm_up(self) -> None:
        """Load and execute a small scene and forget it: see ``warm_up``."""
        data = encode_bundle(warm_up_bundle())
        for _ in range(TIMES):
            scene = PhysicsScene(decode_bundle(data), self._clients, sharing=True)
            rollout = Rollout(WARM_UP, WARM_UP, bundle_digest(data), WARM_UP, PLAN, 0)
            completed = scene.execute(rollout_from_proto(rollout_to_proto(rollout)))
            completed_to_proto(completed).SerializeToString()
            scene.close()


class PhysicsScene:
    """Scene of a bundle in the engine. Every execution has the result of one that starts from the scene as it was loaded."""

    def __init__(self, bundle: Bundle, clients: ClientPool, *, sharing: bool) -> None:
        """Load the scene. With ``sharing``, calls that plans have in common are executed once."""
        self._tasks = bundle.tasks
        self._engine = BulletEngine(bundle.scene, clients, PreparedScene.of(bundle))
        self._simulator = Simulator(bundle, self._engine)
        for task in list(bundle.tasks.values())[:1]:
            # An empty plan completes lazy initialisation before slots are forked.
            self._simulator.execute(task, (), 0)
            judge(task, self._simulator.facts)
        facts = self._simulator.facts
        self._tree = TransitionTree(self._simulator, lambda task: judge(task, facts)) if sharing else None

    def complete(self) -> Iterator[None]:
        """Complete deferred work of later executions."""
        navigator = self._simulator.world.navigator
        navigator.ground.grid.is_free(navigator.start.x_m, navigator.start.y_m)  # connects the free cells
        yield
        yield from self._engine.warm_up()
        yield from self._simulator.warm_up()

    def close(self) -> None:
        """Return the physics clients. The scene can't be used afterwards."""
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
        if rollout.prefix is not None:
            return self._execute_turn(task, rollout, rollout.prefix, on_step, reward)
        if self._tree is not None:
            trace, judgement, shared = self._tree.execute(task, rollout.plan, rollout.seed, on_step)
        else:
            shared = 0
            trace = self._simulator.execute(task, rollout.plan, rollout.seed, on_step)
            judgement = judge(task, self._simulator.facts)
        return Completed(
            reward=worth(task, trace.touched, judgement, reward),
            steps=trace.steps,
            final=trace.final,
            trace_digest=trace.digest,
            worker_id="",
            timings=Timings(),
            warm=True,
            shared_steps=shared,
        )

    def _execute_turn(
        self,
        task: Task,
        turn: Rollout,
        prefix: EpisodePrefix,
        on_step: Callable[[int], None],
        reward: RewardSettings,
    ) -> Completed:
        length = prefix.length
        if self._tree is not None:
            run, judgement, shared = self._tree.execute_turn(
                task, turn.plan, turn.seed, length, on_step, sight=turn.sight
            )
        else:
            shared = 0
            run = self._simulator.execute_turn(task, turn.plan, turn.seed, length, on_step, sight=turn.sight)
            judgement = judge(task, self._simulator.facts)
        prefix.check(run.steps[:length], run.prefix_digest)
        observation = run.observation
        if turn.advise:
            observation = replace(observation, advice=self._advice(task, turn, length))
        return Completed(
            reward=worth(task, run.touched, judgement, reward),
            steps=run.steps[length:],
            final=(),
            trace_digest=run.digest,
            worker_id="",
            timings=Timings(),
            warm=True,
            shared_steps=max(0, shared - length),
            observation=observation,
        )

    def _advice(self, task: Task, turn: Rollout, length: int) -> Advice:
        """Ask the oracle about the state after a turn that was just executed."""
        if self._tree is not None:
            return self._tree.after_turn(task, turn.plan, turn.seed, length, advice_from_here)
        return advice_from_here(self._simulator, task, turn.seed)


if __name__ == "__main__":
    run_program(Physics())
