"""A few bodies in a client of their own, in which one object is let go: the only place where time passes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import ClientPool, pybullet
from embomatrix.sim.engine import SETTLE_STEPS, Settled
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Part

GRAVITY_M_S2: Final = -9.81
CHUNK_STEPS: Final = 12
EARLIEST_STEPS: Final = 36
"""Nobody stops in fewer steps: a thing that hangs 5 mm over its support needs 0.03 s before it moves visibly."""
SLOW_M_S: Final = 4e-3
SLOW_RAD_S: Final = 2e-2
"""Below both speeds the simulation stops early."""
REST_M_S: Final = 2e-2
REST_RAD_S: Final = 0.2
"""Above either speed the object is not at rest when time is up."""
ROLLING_FRICTION: Final = 2e-3
"""Round food is not a ball bearing: a little resistance to rolling lets an apple come to rest."""
FLOOR_HALF_M: Final = 3.0


@dataclass(frozen=True, slots=True)
class Still:
    """An object that stands still in the mini world."""

    asset: Asset
    pose: Pose
    fractions: tuple[float, ...] = ()


class MiniWorld:
    """One client, rebuilt for every stage: what it simulates does not depend on what it simulated before."""

    def __init__(self, pool: ClientPool) -> None:
        self._bullet = pybullet()
        self._pool = pool
        self._client = pool.take()
        self._factory = BodyFactory(self._client)
        self._body = -1
        self._still: list[int] = []

    def stage(
        self,
        asset: Asset,
        pose: Pose,
        fractions: Sequence[float],
        stills: Sequence[Still],
        walls: Sequence[Part] = (),
    ) -> None:
        """Build a world of one object that moves, others that do not, some walls and the floor."""
        bullet, client = self._bullet, self._client
        bullet.resetSimulation(physicsClientId=client)
        self._factory.forget_shapes()
        bullet.setGravity(0, 0, GRAVITY_M_S2, physicsClientId=client)
        self._still = [
            self._factory.floor(pose.position_m[0], pose.position_m[1], FLOOR_HALF_M),
            *self._factory.walls(walls),
            *(self._factory.rigid(item.asset, item.pose, item.fractions, 0.0) for item in stills),
        ]
        self._body = self._factory.rigid(asset, pose, fractions, asset.mass_kg)
        bullet.changeDynamics(
            self._body,
            -1,
            rollingFriction=ROLLING_FRICTION,
            spinningFriction=ROLLING_FRICTION,
            physicsClientId=client,
        )

    def depth_m(self, pose: Pose) -> float:
        """How deep the object, put at a pose, reaches into the bodies that stand still; 0 when it is free."""
        self._put(pose)
        deepest = 0.0
        for other in self._still:
            for contact in self._bullet.getClosestPoints(
                self._body, other, 0.0, physicsClientId=self._client
            ):
                deepest = max(deepest, -contact[8])
        return deepest

    def drop(self, pose: Pose, steps: int = SETTLE_STEPS) -> Settled:
        """Put the object at a pose, let go, and tell where it is when it rests or ``steps`` of 1/240 s have passed."""
        bullet, client = self._bullet, self._client
        self._put(pose)
        done = 0
        linear = angular = math.inf
        while done < steps:
            for _ in range(min(CHUNK_STEPS, steps - done)):
                bullet.stepSimulation(physicsClientId=client)
            done += CHUNK_STEPS
            linear, angular = self._speeds()
            if done >= EARLIEST_STEPS and linear < SLOW_M_S and angular < SLOW_RAD_S:
                break
        position, quat = bullet.getBasePositionAndOrientation(self._body, physicsClientId=client)
        if not all(map(math.isfinite, (*position, *quat, linear, angular))):
            return Settled(pose, math.inf, math.pi, False)
        settled = Pose(tuple(position), tuple(quat))
        at_rest = linear < REST_M_S and angular < REST_RAD_S
        return Settled(settled, math.dist(position, pose.position_m), tilt_between(pose, settled), at_rest)

    def close(self) -> None:
        """Give the client back to the pool. The world can't be used afterwards."""
        self._pool.give_back(self._client)

    def _put(self, pose: Pose) -> None:
        zero = (0.0, 0.0, 0.0)
        self._bullet.resetBasePositionAndOrientation(
            self._body, pose.position_m, pose.quat_xyzw, physicsClientId=self._client
        )
        self._bullet.resetBaseVelocity(self._body, zero, zero, physicsClientId=self._client)

    def _speeds(self) -> tuple[float, float]:
        linear, angular = self._bullet.getBaseVelocity(self._body, physicsClientId=self._client)
        return math.hypot(*linear), math.hypot(*angular)


def tilt_between(before: Pose, after: Pose) -> float:
    """Angle between the upward axes of two poses, in radians: turning about the vertical is no tilt."""
    cosine = float(before.rotation[:, 2] @ after.rotation[:, 2])
    return math.acos(max(-1.0, min(1.0, cosine)))
