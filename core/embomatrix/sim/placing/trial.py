"""Whether a pose will do for an object that is placed: looked at where it is tried, in the engine's present state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.engine import FLOOR, TOLERANCE_M
from embomatrix.sim.geometry.bounds import IDENTITY
from embomatrix.sim.geometry.statics import is_level, rest_pose
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.placing.options import Repertoire, Spots
    from embomatrix.sim.state.relations import Relations
    from embomatrix.world.geometry import Aabb
    from embomatrix.world.poses import StandPose

UNDISTURBED_M: Final = 0.005
"""A pose that was verified offline is settled again when anything but its support is this near."""
NEAR_M: Final = UNDISTURBED_M + TOLERANCE_M
"""The margin of a question after what is that near: one about penetration forgives the tolerance."""


@dataclass(frozen=True, slots=True)
class Errand:
    """What is to be placed where, and from which standing pose it must be in reach."""

    held: str
    target: str
    relation: Relation
    robot: StandPose
    passed_over: tuple[StandPose, ...] = ()


class PoseTrial:
    """Tries poses of a held object in an engine: it is left where it was tried last.

    A pose that is given back has the errand's relation, penetrates nothing, is within the robot's reach and stable.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations, repertoire: Repertoire) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._repertoire = repertoire

    def verified(self, errand: Errand, pose: Pose, nearest: str) -> Pose | None:
        """A pose that was verified with nothing but its support around; it is settled where anything else is near."""
        engine, held, target = self._engine, errand.held, errand.target
        engine.set_pose(held, pose)
        if nearest and self._is_deep(held, nearest):
            return None
        other = engine.penetrates(held, NEAR_M, frozenset((target, FLOOR)))
        if other in self._scene.by_name and self._is_deep(held, other):
            return None
        if other:
            return None if engine.penetrates(held) else self.settled(errand)
        # It was verified with both their joints shut: while they are, it is as free of the support as it was then.
        if any((*engine.joints(target), *engine.joints(held))) and self._is_deep(held, target):
            return None
        return pose if self.holds(errand) else self.settled(errand)

    def proved(self, errand: Errand, spots: Spots, number: int, frames: Mapping[str, Pose]) -> Pose | None:
        """Where the thing rests for certain, with nothing but its support within 5 mm; None when it takes a settle to tell."""
        engine, held, target = self._engine, errand.held, errand.target
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        base = self._repertoire.base(one)
        link, local = spots.ride(number)
        if base is None or not is_level(frames[link]):
            return None
        fractions = engine.joints(target)
        rest = rest_pose(one, base, link_frame(other, IDENTITY, fractions, link) @ local, other, fractions)
        if rest is None:
            return None
        pose = engine.pose(target) @ rest
        x, y, z = pose.position_m
        # Looked at a margin higher up, where what lies below its underside, as the table under a sheet, is far enough away.
        engine.set_pose(held, Pose((x, y, z + NEAR_M), pose.quat_xyzw))
        if engine.penetrates(held, NEAR_M, frozenset((target, FLOOR))):
            return None
        engine.set_pose(held, pose)
        return pose if self.holds(errand) and self.reaches(errand) else None

    def _is_deep(self, held: str, other: str) -> bool:
        gap_m = self._engine.gap(held, other, 0.0)
        return gap_m is not None and gap_m < -TOLERANCE_M

    def settled(self, errand: Errand) -> Pose | None:
        """Let the object go where it is and take the pose where it comes to rest, if all still holds there."""
        settled = self._engine.settle(errand.held)
        if not settled.stable or not self.is_free(errand, settled.pose, "") or not self.reaches(errand):
            return None
        return settled.pose if self.holds(errand) else None

    def holds(self, errand: Errand) -> bool:
        """Whether the relation holds where the object is being tried."""
        match errand.relation:
            case Relation.ONTOP:
                return self._relations.footings.would_be_on(errand.held, errand.target)
            case Relation.INSIDE:
                return self._relations.footings.would_be_in(errand.held, errand.target)
            case _:
                return self._relations.holds(errand.relation, errand.held, errand.target)

    def is_free(self, errand: Errand, pose: Pose, nearest: str) -> bool:
        """Put the object at the pose and tell whether it penetrates nothing there, ``nearest`` the least."""
        self._engine.set_pose(errand.held, pose)
        if nearest and self._is_deep(errand.held, nearest):
            return False
        return not self._engine.penetrates(errand.held)

    def reaches(self, errand: Errand) -> bool:
        return in_reach(self._engine.aabb(errand.held), errand.robot)


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Whether the arm reaches the nearest point of a box in the plane, and its middle's height."""
    dx = max(box.low_m[0] - robot.x_m, robot.x_m - box.high_m[0], 0.0)
    dy = max(box.low_m[1] - robot.y_m, robot.y_m - box.high_m[1], 0.0)
    height = box.center_m[2]
    return math.hypot(dx, dy) <= ROBOT.reach_m and ROBOT.reach_low_m <= height <= ROBOT.reach_high_m
