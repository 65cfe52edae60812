"""The row as a user would write it: every rollout loads each object from its URDF, and steps a world that never sleeps.

Left out are the tricks: shapes are not shared by the objects of one model, nothing at rest is put to sleep, and every step
lasts 1/240 s. A rollout in such a world takes minutes. So loading is measured, and what a step costs once the scene is loaded;
the steps are those that the naive row's rollout of the same plan took. What the robot's own motions cost is left out.
"""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Final

from embomatrix.bench.engine.urdf import write_urdf
from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import pybullet
from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.dynamic_bodies import DynamicBodies
from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import decode_bundle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from embomatrix.bench.cluster.one_process import NaiveRollout
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Scene

STEPS: Final = 120
"""Steps that are measured: half a second of simulated time, with everything in place."""


def user_s(taken: Sequence[NaiveRollout], bundles: Mapping[str, bytes], folder: Path) -> list[float]:
    """Seconds that each of these rollouts would take, at the least.

    The URDFs are written below ``folder`` before the clock starts, as a library of objects brings them.
    """
    seconds = []
    for item in taken:
        data = bundles[item.rollout.bundle_digest]
        files = UrdfFiles(folder)
        files.write_all(decode_bundle(data, digest=item.rollout.bundle_digest).scene)
        started_s = time.perf_counter()
        bundle = decode_bundle(data, digest=item.rollout.bundle_digest)
        world = UserWorld(bundle.scene, files)
        with contextlib.closing(load_simulator(bundle, actor=PhysicalActor(bundle, world))) as simulator:
            simulator.reset(bundle.tasks[item.rollout.task_id], item.rollout.seed)
            loaded_s = time.perf_counter()
            world.step(STEPS)
            step_s = (time.perf_counter() - loaded_s) / STEPS
        seconds.append(loaded_s - started_s + step_s * item.steps)
    return seconds


class UrdfFiles:
    """URDFs of a scene's assets: one with joints for each, and one with fixed joints for what can be carried."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._paths: dict[tuple[str, tuple[float, ...] | None], Path] = {}

    def write_all(self, scene: Scene) -> None:
        """Write what the scene's objects need."""
        for item in scene.objects:
            fixed_at = None if item.fixed else tuple(item.joints)
            self.path(scene.asset_of(item.name), fixed_at)

    def path(self, asset: Asset, fixed_at: tuple[float, ...] | None) -> Path:
        """The file of an asset, written when it is first asked for."""
        key = (asset.asset_id, fixed_at)
        if key not in self._paths:
            self._paths[key] = write_urdf(asset, self._folder, f"asset-{len(self._paths)}", fixed_at)
        return self._paths[key]


class UrdfFactory(BodyFactory):
    """Makes an asset's bodies of its URDF. Walls and floor are made as ever."""

    def __init__(self, client: int, files: UrdfFiles) -> None:
        super().__init__(client)
        self._files = files

    def jointed(self, asset: Asset, poses: Sequence[Pose]) -> tuple[int, ...]:
        return tuple(self._load(asset, pose, None, fixed=True) for pose in poses)

    def rigid(self, asset: Asset, pose: Pose, fractions: Sequence[float], mass_kg: float) -> int:
        return self._load(asset, pose, tuple(fractions), fixed=False)

    def hinged(self, asset: Asset, pose: Pose) -> int:
        return self._load(asset, pose, None, fixed=True)

    def joint_indices(self, asset: Asset) -> tuple[int, ...]:
        return tuple(range(len(asset.joints)))

    def _load(self, asset: Asset, pose: Pose, fixed_at: tuple[float, ...] | None, *, fixed: bool) -> int:
        return int(
            pybullet().loadURDF(
                str(self._files.path(asset, fixed_at)),
                basePosition=pose.position_m,
                baseOrientation=pose.quat_xyzw,
                useFixedBase=fixed,
                physicsClientId=self._client,
            )
        )


class UserBodies(DynamicBodies):
    """Bodies that never sleep."""

    def __init__(self, scene: Scene, client: int, files: UrdfFiles) -> None:
        super().__init__(scene, client)
        self._factory = UrdfFactory(client, files)

    def sleep(self, name: str) -> None:
        """Stay awake."""

    def still_sleep(self) -> None:
        """Stay awake."""


class UserWorld(DynamicWorld):
    """A world of such bodies."""

    def __init__(self, scene: Scene, files: UrdfFiles) -> None:
        super().__init__(scene)
        self.bodies = UserBodies(scene, self._client, files)
