"""Settling of a whole scene: all movable objects fall at once in a temporary client."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import BulletClient, connect
from embomatrix.sim.bullet.mini_world import CHUNK_STEPS, GRAVITY_M_S2, SLOW_M_S, SLOW_RAD_S, settled_from
from embomatrix.sim.engine import BACKGROUND, FLOOR, TOLERANCE_M, WALL, Settled
from embomatrix.sim.validation import check_scene
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Scene

LEAST_STEPS: Final = 120
MOST_STEPS: Final = 480
"""Steps of 1/240 s: at least half a second, two if something still moves."""
MARGIN_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class SettledScene:
    """Final poses of the movable objects, and pairs that then overlap by more than 1 mm, with the depth in metres."""

    objects: Mapping[str, Settled]
    overlaps: Mapping[tuple[str, str], float]

    @property
    def unstable(self) -> tuple[str, ...]:
        return tuple(name for name, settled in self.objects.items() if not settled.stable)


def settle_scene(scene: Scene) -> SettledScene:
    """Let all movable objects fall until they rest or two seconds have passed; furniture stays fixed and shut.

    Raises EngineError if the engine is missing or refuses the scene.
    """
    check_scene(scene)
    client = connect()
    try:
        return _Fall(scene, client).run()
    finally:
        client.disconnect()


class _Fall:
    """Scene in one client, with mass on movable objects."""

    def __init__(self, scene: Scene, client: BulletClient) -> None:
        self._bullet = client
        factory = BodyFactory(client)
        self._bullet.resetSimulation()
        self._bullet.setGravity(0, 0, GRAVITY_M_S2)
        low = np.min([room.low_m for room in scene.rooms], axis=0)
        high = np.max([room.high_m for room in scene.rooms], axis=0)
        x, y = (low + high) / 2
        floor = factory.floor(float(x), float(y), float(max(high - low)) / 2 + MARGIN_M)
        self._names = {floor: FLOOR, **dict.fromkeys(factory.statics(scene.walls), WALL)}
        self._names |= dict.fromkeys(factory.statics(scene.background_parts), BACKGROUND)
        self._starts: dict[int, Pose] = {}
        for item in scene.objects:
            if item.absent:
                continue
            asset = scene.assets[item.asset_id]
            fractions = item.joints or (0.0,) * len(asset.joints)
            mass_kg = 0.0 if item.fixed else asset.mass_kg
            body = factory.rigid(asset, item.pose_world_asset, fractions, mass_kg)
            self._names[body] = item.name
            if not item.fixed:
                self._starts[body] = item.pose_world_asset
                factory.brake(body)

    def run(self) -> SettledScene:
        done = 0
        while done < LEAST_STEPS or (done < MOST_STEPS and self._moves()):
            for _ in range(CHUNK_STEPS):
                self._bullet.stepSimulation()
            done += CHUNK_STEPS
        objects = {self._names[body]: self._settled(body, start) for body, start in self._starts.items()}
        return SettledScene(objects, self._overlaps())

    def _moves(self) -> bool:
        for body in self._starts:
            linear, angular = self._bullet.getBaseVelocity(body)
            if not (math.hypot(*linear) < SLOW_M_S and math.hypot(*angular) < SLOW_RAD_S):
                return True
        return False

    def _settled(self, body: int, start: Pose) -> Settled:
        position, quat = self._bullet.getBasePositionAndOrientation(body)
        linear, angular = self._bullet.getBaseVelocity(body)
        return settled_from(start, position, quat, math.hypot(*linear), math.hypot(*angular))

    def _overlaps(self) -> dict[tuple[str, str], float]:
        """Pairs in contact deeper than the tolerance; pairs of immovable bodies are left out."""
        deepest: dict[tuple[str, str], float] = {}
        for contact in self._bullet.getContactPoints():
            pair = (self._names[contact[1]], self._names[contact[2]])
            if -contact[8] > max(TOLERANCE_M, deepest.get(pair, 0.0)):
                deepest[pair] = -contact[8]
        return deepest
