"""Small settling world: a client with a few bodies in which one object is let go."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.engine import SETTLE_STEPS, Settled
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Quat, Shape, Vec3

GRAVITY_M_S2: Final = -9.81
CHUNK_STEPS: Final = 12
EARLIEST_STEPS: Final = 36
"""Fewest steps of a settle: an object 5 mm over its support needs 0.03 s before it moves visibly."""
SLOW_M_S: Final = 4e-3
SLOW_RAD_S: Final = 2e-2
"""The simulation stops early below both speeds."""
REST_M_S: Final = 2e-2
REST_RAD_S: Final = 0.2
"""Above either speed at the end, the object is not at rest."""
ROUND: Final = frozenset((Shape.CYLINDER, Shape.SPHERE, Shape.HULL))
"""Shapes that may roll and so get rolling friction. With it the solver uses all its iterations: a step costs five times as
much."""
FLOOR_M: Final = 6.0
AWAY_M: Final = 100.0
FLOOR_THICKNESS_M: Final = 0.5
LEVEL_M: Final = 0.002
PROBE_M: Final = 0.01
PROBED: Final = (0.04, 0.5, 0.96)
"""Probed points of a box's underside, as shares of its sides."""
STAGES_KEPT: Final = 1024
"""Stages between two resets. A stage leaks 5 to 10 kB; a reset costs a forked process 7 MB of shared memory. A slot is
replaced before it has settled so often."""
EVERYWHERE: Final = Aabb((-math.inf,) * 3, (math.inf,) * 3)


@dataclass(frozen=True, slots=True)
class StaticObject:
    """Static object in the settling world."""

    asset: Asset
    pose: Pose
    fractions: tuple[float, ...] = ()


class MiniWorld:
    """Client in which one object moves and nothing else does. Results do not depend on earlier ones.

    All static parts form one body, or a few: a step costs what the object touches, not the size of the furniture. Each stage
    builds new bodies and removes the last ones; an occasional reset of the client frees the leaked shapes.
    """

    def __init__(self, pool: ClientPool) -> None:
        self._pool = pool
        self._bullet = pool.take()
        self._factory = BodyFactory(self._bullet, plain=True)
        self._body = -1
        self._still: tuple[int, ...] = ()
        self._stages = 0
        self._set_rules()
        # Triggers Bullet's first-step allocations here, which processes forked later then share.
        self._bullet.stepSimulation()

    def stage(
        self,
        asset: Asset,
        pose: Pose,
        fractions: Sequence[float],
        stills: Sequence[StaticObject],
        parts: Sequence[ConvexPart] = (),
        region: Aabb | None = None,
    ) -> None:
        """Build a world of one moving object, static ones, static parts such as walls, and the floor.

        With a ``region``, only static parts that reach into it are built.
        """
        self._clear()
        x, y, _ = pose.position_m
        slab = ConvexPart(
            Shape.BOX, Pose((x, y, -FLOOR_THICKNESS_M / 2)), (FLOOR_M, FLOOR_M, FLOOR_THICKNESS_M)
        )
        still = [slab, *parts]
        for item in stills:
            box = region if region is not None else EVERYWHERE
            still += bounds_of(item.asset).parts_within(item.pose, item.fractions, box)
        self._still = self._factory.statics(still)
        self._body = self._factory.rigid(asset, pose, fractions, asset.mass_kg)
        if any(part.shape in ROUND for link in asset.links for part in link.parts):
            self._factory.brake(self._body)

    def _clear(self) -> None:
        self._stages += 1
        if self._stages % STAGES_KEPT == 0:
            self._renew()
        elif self._still:
            for body in (self._body, *self._still):
                self._bullet.removeBody(body)

    def _renew(self) -> None:
        """Free the leaked shapes of earlier stages."""
        self._bullet.resetSimulation()
        self._factory.forget_shapes()
        self._set_rules()

    def _set_rules(self) -> None:
        """Configure an empty client."""
        self._bullet.setGravity(0, 0, GRAVITY_M_S2)
        # Contacts are solved in the order of body creation, independent of the broad phase's history.
        self._bullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1)

    def lift(self) -> None:
        """Move the object out of the way, for queries about static bodies."""
        self._put(Pose((0.0, 0.0, AWAY_M)))

    def depth_m(self, pose: Pose) -> float:
        """Penetration depth of the object, put at a pose, into static bodies; 0 for none."""
        self._put(pose)
        deepest = 0.0
        for other in self._still:
            for contact in self._bullet.getClosestPoints(self._body, other, 0.0):
                deepest = max(deepest, -contact[8])
        return deepest

    def is_level_under(self, box: Aabb) -> bool:
        """Return True if static bodies are level, to 2 mm, under nine points of a box's underside."""
        (low_x, low_y, z), (high_x, high_y, _) = box.low_m, box.high_m
        starts = [
            (low_x + u * (high_x - low_x), low_y + v * (high_y - low_y), z + PROBE_M)
            for u in PROBED
            for v in PROBED
        ]
        ends = [(x, y, z - LEVEL_M) for x, y, _ in starts]
        hits = self._bullet.rayTestBatch(starts, ends)
        return all(hit[0] in self._still and abs(hit[3][2] - z) <= LEVEL_M for hit in hits)

    def drop(self, pose: Pose, steps: int = SETTLE_STEPS, least: int = EARLIEST_STEPS) -> Settled:
        """Put the object at the pose, let go, and return its pose at rest or after ``steps`` of 1/240 s.

        It does not count as at rest before ``least`` steps.
        """
        self._put(pose)
        done = 0
        linear = angular = math.inf
        while done < steps:
            for _ in range(min(CHUNK_STEPS, steps - done)):
                self._bullet.stepSimulation()
            done += CHUNK_STEPS
            linear, angular = self._speeds()
            if done >= least and linear < SLOW_M_S and angular < SLOW_RAD_S:
                break
        position, quat = self._bullet.getBasePositionAndOrientation(self._body)
        return settled_from(pose, position, quat, linear, angular)

    def close(self) -> None:
        """Return the client and end the world's use."""
        self._pool.give_back(self._bullet)

    def _put(self, pose: Pose) -> None:
        zero = (0.0, 0.0, 0.0)
        self._bullet.resetBasePositionAndOrientation(self._body, pose.position_m, pose.quat_xyzw)
        self._bullet.resetBaseVelocity(self._body, zero, zero)

    def _speeds(self) -> tuple[float, float]:
        linear, angular = self._bullet.getBaseVelocity(self._body)
        return math.hypot(*linear), math.hypot(*angular)


def settled_from(start: Pose, position: Vec3, quat: Quat, speed_m_s: float, speed_rad_s: float) -> Settled:
    """Outcome of a fall from its end; not at rest, and infinitely far, if physics lost the object."""
    if not all(map(math.isfinite, (*position, *quat, speed_m_s, speed_rad_s))):
        return Settled(start, math.inf, math.pi, False)
    pose = Pose(position, quat)
    at_rest = speed_m_s < REST_M_S and speed_rad_s < REST_RAD_S
    return Settled(pose, math.dist(position, start.position_m), _tilt_between(start, pose), at_rest)


def _tilt_between(before: Pose, after: Pose) -> float:
    """Angle in radians between the upward axes of two poses; rotation about the vertical does not count."""
    cosine = float(before.rotation[:, 2] @ after.rotation[:, 2])
    return math.acos(max(-1.0, min(1.0, cosine)))
