"""Trial of a pose for an object that is placed, in the engine's present state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.engine import FLOOR, TOLERANCE_M, PhysicsEngine
from embomatrix.sim.geometry.statics import is_level, rest_pose
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import IDENTITY, Aabb, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.sim.placing.options import CandidatePoses, PlacementOptions

UNDISTURBED_M: Final = 0.005
"""A pose verified offline is settled again if anything but its support is this near."""
NEAR_M: Final = UNDISTURBED_M + TOLERANCE_M
"""Margin for penetration queries at this distance, which subtract the tolerance."""


@dataclass(frozen=True, slots=True)
class PlacementRequest:
    """Request to place an object: relation, target and the standing pose that must reach it."""

    held: str
    target: str
    relation: Relation
    robot: StandPose
    excluded_stands: tuple[StandPose, ...] = ()


class PoseTrial:
    """Tries poses of a held object in an engine and leaves the object where it was tried last.

    A returned pose has the requested relation, penetrates nothing, is within the robot's reach and is stable.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations, options: PlacementOptions) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._options = options

    def verified(self, request: PlacementRequest, pose: Pose, nearest: str) -> Pose | None:
        """Accept a pose that was verified with nothing but its support around; settle it if anything else is near."""
        engine, held, target = self._engine, request.held, request.target
        engine.set_pose(held, pose)
        if nearest and self._is_deep(held, nearest):
            return None
        other = engine.penetrates(held, NEAR_M, frozenset((target, FLOOR)))
        if other in self._scene.by_name and self._is_deep(held, other):
            return None
        if other:
            return None if engine.penetrates(held) else self.settled(request)
        # The pose was verified with all joints shut: while they are, the object is free of its support.
        if any((*engine.joints(target), *engine.joints(held))) and self._is_deep(held, target):
            return None
        return pose if self.holds(request) else self.settled(request)

    def proved(
        self, request: PlacementRequest, options: CandidatePoses, number: int, frames: Mapping[str, Pose]
    ) -> Pose | None:
        """Rest pose by statics with nothing but the support within 5 mm; None if only a settle can decide."""
        engine, held, target = self._engine, request.held, request.target
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        base = self._options.base(one)
        link, local = options.link_pose(number)
        if base is None or not is_level(frames[link]):
            return None
        fractions = engine.joints(target)
        rest = rest_pose(one, base, link_frame(other, IDENTITY, fractions, link) @ local, other, fractions)
        if rest is None:
            return None
        pose = engine.pose(target) @ rest
        x, y, z = pose.position_m
        # Checked slightly higher, out of range of objects below the support, such as the table under a sheet.
        engine.set_pose(held, Pose((x, y, z + NEAR_M), pose.quat_xyzw))
        if engine.penetrates(held, NEAR_M, frozenset((target, FLOOR))):
            return None
        engine.set_pose(held, pose)
        return pose if self.holds(request) and self.reaches(request) else None

    def _is_deep(self, held: str, other: str) -> bool:
        gap_m = self._engine.gap(held, other, 0.0)
        return gap_m is not None and gap_m < -TOLERANCE_M

    def settled(self, request: PlacementRequest) -> Pose | None:
        """Let the object settle and accept the pose if all conditions still hold."""
        settled = self._engine.settle(request.held)
        if not settled.stable or not self.is_free(request, settled.pose, "") or not self.reaches(request):
            return None
        return settled.pose if self.holds(request) else None

    def holds(self, request: PlacementRequest) -> bool:
        """Return True if the relation holds at the pose under trial."""
        match request.relation:
            case Relation.ONTOP:
                return self._relations.supports.would_be_on(request.held, request.target)
            case Relation.INSIDE:
                return self._relations.supports.would_be_in(request.held, request.target)
            case _:
                return self._relations.holds(request.relation, request.held, request.target)

    def is_free(self, request: PlacementRequest, pose: Pose, nearest: str) -> bool:
        """Put the object at the pose. Return True if it penetrates nothing; ``nearest`` is checked first."""
        self._engine.set_pose(request.held, pose)
        if nearest and self._is_deep(request.held, nearest):
            return False
        return not self._engine.penetrates(request.held)

    def reaches(self, request: PlacementRequest) -> bool:
        return in_reach(self._engine.aabb(request.held), request.robot)


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Return True if the arm reaches the nearest point of a box in the plane, and the height of its middle."""
    near = box.level_distance_m(robot.x_m, robot.y_m) <= ROBOT.reach_m
    return near and ROBOT.reach_low_m <= box.center_m[2] <= ROBOT.reach_high_m
