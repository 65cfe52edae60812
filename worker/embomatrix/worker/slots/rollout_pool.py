"""Rollouts in local processes without a cluster, scene by scene, with the code of the workers.

Processes are spawned, never forked, because the parent may hold threads. If one dies, its scene is executed once more alone and
then given up.
"""

import concurrent.futures
import functools
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from embomatrix.rpc.wire.values import InfraCode, InfraFailure, Outcome, Rollout
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.engine import EngineError, EngineMissingError
from embomatrix.sim.process_pool import process_pool
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE, PhysicsScene
from embomatrix.world.dataset import Dataset, DatasetError

OnResult = Callable[[str, Outcome], None]
Results = list[tuple[str, Outcome]]
Waiting = dict[concurrent.futures.Future[Results], list[Rollout]]


class RolloutPool:
    """Executes rollouts of a dataset's bundles."""

    def __init__(self, folder: Path, processes: int) -> None:
        self._folder = folder
        self._processes = processes

    def execute(self, rollouts: Sequence[Rollout], on_result: OnResult) -> None:
        """Execute each rollout once; ``on_result`` gets id and outcome, scene by scene in the order of completion.

        Raise EngineMissingError.
        """
        scenes: dict[str, list[Rollout]] = {}
        for rollout in rollouts:
            scenes.setdefault(rollout.bundle_digest, []).append(rollout)
        broken = self._run(list(scenes.values()), min(self._processes, len(scenes)), on_result)
        for scene in broken:
            if self._run([scene], 1, on_result):
                for rollout in scene:
                    on_result(
                        rollout.rollout_id, InfraFailure(InfraCode.SLOT_CRASHED, "the simulator died, twice")
                    )

    def _run(
        self, scenes: Sequence[list[Rollout]], processes: int, on_result: OnResult
    ) -> list[list[Rollout]]:
        """Execute scenes and return those whose process died, or that waited behind it."""
        broken: list[list[Rollout]] = []
        with process_pool(processes) as pool:
            waiting: Waiting = {pool.submit(execute_scene, self._folder, scene): scene for scene in scenes}
            for future in concurrent.futures.as_completed(waiting):
                try:
                    results = future.result()
                except BrokenProcessPool:
                    broken.append(waiting[future])
                    continue
                for rollout_id, outcome in results:
                    on_result(rollout_id, outcome)
        return broken


def execute_scene(folder: Path, rollouts: Sequence[Rollout]) -> Results:
    """Execute rollouts of one bundle in this process; if the scene can't be loaded, each of them fails.

    Raise EngineMissingError if there is no physics engine.
    """
    try:
        bundle = Dataset(folder, ()).read_bundle(rollouts[0].bundle_digest)
        scene = PhysicsScene(bundle, _clients(), sharing=True)
    except EngineMissingError:
        raise
    except (DatasetError, EngineError) as error:
        failure = InfraFailure(InfraCode.SCENE_LOAD_FAILED, str(error))
        return [(rollout.rollout_id, failure) for rollout in rollouts]
    try:
        return [(rollout.rollout_id, scene.execute(rollout)) for rollout in rollouts]
    finally:
        scene.close()


@functools.cache
def _clients() -> ClientPool:
    """Physics clients of this process, for one scene after another."""
    return ClientPool(spare=CLIENTS_PER_SCENE)
