"""Offline placement reachability: verified poses at which the arm can place an object, and the blocker where there are none.

Cached and physical mode prefer the same reachable poses, so an object ends at the same place in both.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from embomatrix.sim.joints.panels import swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.physical.pick import pick_paths
from embomatrix.sim.physical.place import PLACES
from embomatrix.sim.physical.put import PutRequest
from embomatrix.sim.physical.reach import ArmPath
from embomatrix.sim.physical.stage import Grip, PhysicalStage
from embomatrix.sim.placing.placement import Placer
from embomatrix.skills.failure import FailureReason
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.state import Relation

POSES_EXAMINED: Final = 9
"""Poses of one object at one target to examine."""
POSE_BUDGET: Final = 500
"""Poses to examine in one scene. The first queries use up the budget."""
FEW_PLACES: Final = 6
"""Targets with at most this many free places are examined completely before they count as unreachable."""
APART_M: Final = 0.02
"""Poses nearer to each other than this count as one place."""


@dataclass(frozen=True, slots=True)
class PlacementQuery:
    """Question whether the arm can put one object in a relation to another."""

    held: str
    target: str
    relation: Relation


class PlacementReachability:
    """Search for arm paths to poses, in the initial state of a scene. Nothing is stepped."""

    def __init__(self, stage: PhysicalStage, poses: PoseCache) -> None:
        """``poses`` are the placements and standing poses of the stage's scene."""
        self._stage = stage
        self._world = stage.world
        self._poses = poses
        self._placer = Placer(stage.world.engine, stage.world.relations, poses, stage.world.navigator)
        self._grips: dict[str, Grip | None] = {}
        self._examined = 0

    def seen(self, queries: Iterable[PlacementQuery]) -> PoseCache:
        """Return the poses with the answers to these queries, the first ones as far as the budget lasts."""
        reached: dict[Relation, dict[str, dict[str, int]]] = {}
        blockers: dict[Relation, dict[str, dict[str, str]]] = {}
        for query in dict.fromkeys(queries):
            if self._examined >= POSE_BUDGET:
                break
            number, other = self._answer(query)
            if number is not None:
                reached.setdefault(query.relation, {}).setdefault(query.held, {})[query.target] = number
            if other:
                blockers.setdefault(query.relation, {}).setdefault(query.held, {})[query.target] = other
        return replace(self._poses, reached=reached, placing_blockers=blockers)

    def _answer(self, query: PlacementQuery) -> tuple[int | None, str]:
        """Return the number of the first reachable pose, and the blocker if all poses are certainly unreachable."""
        stands = self._poses.stands.get(query.target, ())
        if not stands or not self._placer.has_verified(query.held, query.target, query.relation):
            return None, ""
        grip = self._grip(query.held)
        if grip is None:
            return None, ""
        self._make_ready(query)
        # The robot has stepped aside from the open panels.
        stand = self._world.navigator.step_aside(query.target, stands[0])
        poses = self._placer.verified(query.held, query.target, query.relation, stand, POSES_EXAMINED)
        if not poses:
            return None, ""
        self._stage.stand_at(stand)
        self._stage.grip = grip

        def is_valid() -> bool:
            return self._world.relations.holds(query.relation, query.held, query.target)

        request = PutRequest(self._stage, grip, [pose for _, pose in poses], is_valid)
        path = next(request.paths(), None)
        index = len(poses) - 1
        if path is not None:
            index = _nearest([pose for _, pose in poses], path.tool_path.key_pose @ grip.pose_tool_object)
        self._examined += index + 1
        other = "" if path is not None else self._blocker(query, grip, stand, is_valid)
        self._stage.grip = None
        return None if path is None else poses[index][0], other

    def _blocker(
        self, query: PlacementQuery, grip: Grip, stand: StandPose, is_valid: Callable[[], bool]
    ) -> str:
        """Return the blocker of every pose; "" if one may be reachable or there are too many to examine.

        A place from which the hand can't pick the object up is unreachable with any grasp, unless the object is dropped.
        """
        held = query.held
        poses = self._placer.choices(held, query.target, query.relation, stand, most=PLACES)
        if isinstance(poses, FailureReason):
            return ""
        places = _apart(poses)
        if len(places) > FEW_PLACES:
            return ""
        request = PutRequest(self._stage, grip, poses, is_valid)
        if any(self._could_take(held, pose) for pose in places):
            return ""
        if any(True for _ in itertools.chain(request.drops(), request.paths())):
            return ""
        return request.reach.blocker or query.target

    def _could_take(self, name: str, pose: Pose) -> bool:
        """True if the empty hand could pick the object up at a pose."""
        stage, engine = self._stage, self._world.engine
        grip, stage.grip = stage.grip, None
        engine.set_pose(name, pose)
        found = self._pick_path(name)
        engine.park(name)
        stage.grip = grip
        return found is not None

    def _pick_path(self, name: str) -> ArmPath | None:
        """Return the first free path that picks the object up at its present pose, None for none."""
        tool_paths, _, bases = pick_paths(self._stage, name)
        return next(self._stage.reach(self._stage.boxes(), name).paths(tool_paths, bases), None)

    def _grip(self, name: str) -> Grip | None:
        """Return the grip after the object was picked up at its initial place, None if the hand finds no path."""
        if name not in self._grips:
            self._grips[name] = self._find_grip(name)
        return self._grips[name]

    def _find_grip(self, name: str) -> Grip | None:
        world, stage = self._world, self._stage
        stands = self._poses.stands.get(name, ())
        if not stands or world.burden(name):
            return None
        world.engine.reset()
        stage.open_around(name)
        world.navigator.refresh()
        stage.stand_at(stands[0])
        path = self._pick_path(name)
        if path is None:
            return None
        return stage.grip_with(path.tool_path.key_pose, world.engine.pose(name), name)

    def _make_ready(self, query: PlacementQuery) -> None:
        """Restore the initial scene, with the object in the hand and the target open."""
        world = self._world
        world.engine.reset()
        world.hand.take(world.cargo(query.held))
        self._stage.open_around(query.target)
        if query.relation is Relation.INSIDE:
            swing_panels(world.engine, world.relations, query.target, SWING)
        world.navigator.refresh()


def _nearest(poses: Sequence[Pose], there: Pose) -> int:
    """Return the index of the nearest of some poses."""
    return min(range(len(poses)), key=lambda index: math.dist(poses[index].position_m, there.position_m))


def _apart(poses: Sequence[Pose]) -> list[Pose]:
    """Return the first pose at each place."""
    found: list[Pose] = []
    for pose in poses:
        if all(math.dist(pose.position_m, other.position_m) > APART_M for other in found):
            found.append(pose)
    return found
