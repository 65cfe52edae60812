"""What the cluster's benches execute: the plans of the pinned workload, as rollouts that a trainer would submit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING

from embomatrix.bench.engine.engine import check_scenes
from embomatrix.rpc.wire.values import Rollout

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.bench.engine.workload import SceneWork, Workload
    from embomatrix.world.dataset import Dataset


@dataclass(frozen=True, slots=True)
class ClusterWorkload:
    """Scenes of the workload with their plans, and their bundles by digest."""

    scenes: tuple[SceneWork, ...]
    bundles: Mapping[str, bytes]

    @property
    def rollouts(self) -> tuple[Rollout, ...]:
        """Every plan once, scene by scene."""
        return tuple(rollout for scene in self.scenes for rollout in rollouts_of(scene))

    def first(self, plans: int) -> ClusterWorkload:
        """The same scenes with so many plans each, at most."""
        scenes = tuple(replace(scene, executions=scene.executions[:plans]) for scene in self.scenes)
        return ClusterWorkload(scenes, self.bundles)

    def after(self, plans: int) -> ClusterWorkload:
        """The same scenes without so many plans, the first of each."""
        scenes = tuple(replace(scene, executions=scene.executions[plans:]) for scene in self.scenes)
        return ClusterWorkload(scenes, self.bundles)

    def sample(self, count: int) -> tuple[Rollout, ...]:
        """Up to ``count`` of them, spread over the scenes: the first plan of each, then the second of each."""
        turns = zip_longest(*(rollouts_of(scene) for scene in self.scenes))
        return tuple(rollout for turn in turns for rollout in turn if rollout is not None)[:count]

    def steps(self, scenes: int) -> tuple[tuple[Rollout, ...], ...]:
        """The same as the steps of a training run, with so many scenes in each."""
        starts = range(0, len(self.scenes), scenes)
        return tuple(
            tuple(rollout for scene in self.scenes[start : start + scenes] for rollout in rollouts_of(scene))
            for start in starts
        )


def main_work(dataset: Dataset, workload: Workload) -> ClusterWorkload:
    """The scenes of the workload's main size. Raises BenchError when dataset and workload don't belong together."""
    return _work(workload.main, check_scenes(dataset, workload))


def whole_work(dataset: Dataset, workload: Workload) -> ClusterWorkload:
    """The scenes of all sizes, the main one first. Raises BenchError as ``main_work`` does."""
    others = tuple(scene for scene in workload.scenes if scene not in workload.main)
    return _work((*workload.main, *others), check_scenes(dataset, workload))


def _work(scenes: tuple[SceneWork, ...], bundles: Mapping[str, bytes]) -> ClusterWorkload:
    return ClusterWorkload(scenes, {scene.bundle_digest: bundles[scene.bundle_digest] for scene in scenes})


def rollouts_of(scene: SceneWork) -> tuple[Rollout, ...]:
    """The scene's plans. Each is a group of its own: they differ in task and seed."""
    return tuple(
        Rollout(
            rollout_id=f"{scene.scene_id}/{number}",
            group_id=f"{scene.scene_id}/{number}",
            bundle_digest=scene.bundle_digest,
            task_id=item.task_id,
            plan=item.plan,
            seed=item.seed,
        )
        for number, item in enumerate(scene.executions)
    )


def scenes_in(rollouts: Sequence[Rollout]) -> dict[str, int]:
    """How many of the rollouts are in each scene, by digest, in the order of their first ones."""
    counts: dict[str, int] = {}
    for rollout in rollouts:
        counts[rollout.bundle_digest] = counts.get(rollout.bundle_digest, 0) + 1
    return counts
