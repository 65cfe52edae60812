"""Looking ahead at placing, offline: at which verified poses the arm gets with what it holds, and what bars it from all.

Cached mode and physical mode then prefer the same poses, those that the arm was seen to get at, and a thing ends at the same
place in both.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.sim.joints.panels import swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.physical.hands import ways_to
from embomatrix.sim.physical.place import PLACES
from embomatrix.sim.physical.put import PutRequest
from embomatrix.sim.placing.placement import Placer
from embomatrix.skills.failure import FailureReason
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from embomatrix.sim.physical.stage import Grip, PhysicalStage
    from embomatrix.world.geometry import Pose
    from embomatrix.world.poses import PoseCache, StandPose

LOOKS: Final = 9
"""Poses of one thing at one target that are looked at."""
MOST_LOOKS: Final = 500
"""Poses that are looked at in one scene: the first targets that are asked about get them."""
FEW: Final = 6
"""Of a target with no more free places than these it is made sure that no hold leads to any, where none was seen to."""
APART_M: Final = 0.02
"""Poses nearer than this are at one place: on what is hardly wider than a thing that has no other."""


@dataclass(frozen=True, slots=True)
class Placing:
    """One object put in a relation to another."""

    held: str
    target: str
    relation: Relation


class Prospects:
    """Asks the arm about places in a scene as it was loaded. Nothing is stepped."""

    def __init__(self, stage: PhysicalStage, poses: PoseCache) -> None:
        """``poses`` are placements and standing poses of the stage's scene."""
        self._stage = stage
        self._world = stage.world
        self._poses = poses
        self._placer = Placer(stage.world.engine, stage.world.relations, poses, stage.world.navigator)
        self._grips: dict[str, Grip | None] = {}
        self._looks = 0

    def seen(self, placings: Iterable[Placing]) -> PoseCache:
        """The poses with what was found out about placing these, the first of them as long as it lasts."""
        reached: dict[Relation, dict[str, dict[str, int]]] = {}
        barred: dict[Relation, dict[str, dict[str, str]]] = {}
        for placing in dict.fromkeys(placings):
            if self._looks >= MOST_LOOKS:
                break
            number, other = self._look(placing)
            if number is not None:
                reached.setdefault(placing.relation, {}).setdefault(placing.held, {})[placing.target] = number
            if other:
                barred.setdefault(placing.relation, {}).setdefault(placing.held, {})[placing.target] = other
        return replace(self._poses, reached=reached, barred_places=barred)

    def _look(self, placing: Placing) -> tuple[int | None, str]:
        """Number of the first pose that the arm gets at, and what bars the way to all when it is sure that it gets at none."""
        stands = self._poses.stands.get(placing.target, ())
        if not stands or not self._placer.has_verified(placing.held, placing.target, placing.relation):
            return None, ""
        grip = self._grip(placing.held)
        if grip is None:
            return None, ""
        self._make_ready(placing)
        # Who opened the target has stepped aside from its leaves.
        stand = self._world.navigator.step_aside(placing.target, stands[0])
        poses = self._placer.verified(placing.held, placing.target, placing.relation, stand, LOOKS)
        if not poses:
            return None, ""
        self._stage.stand_at(stand)
        self._stage.grip = grip

        def counts() -> bool:
            return self._world.relations.holds(placing.relation, placing.held, placing.target)

        delivery = PutRequest(self._stage, grip, [pose for _, pose in poses], counts)
        way = next(delivery.ways(), None)
        index = len(poses) - 1
        if way is not None:
            index = _nearest([pose for _, pose in poses], way.track.key_pose @ grip.pose_tool_object)
        self._looks += index + 1
        other = "" if way is not None else self._bars(placing, grip, stand, counts)
        self._stage.grip = None
        return None if way is None else poses[index][0], other

    def _bars(self, placing: Placing, grip: Grip, stand: StandPose, counts: Callable[[], bool]) -> str:
        """What bars the way to every pose; "" when one may lead there with some hold, or there are too many to ask about all.

        Where the hand could not take a thing from it can't put it, however it holds it, unless it lets it fall from above.
        """
        held = placing.held
        poses = self._placer.choices(held, placing.target, placing.relation, stand, most=PLACES)
        if isinstance(poses, FailureReason):
            return ""
        places = _apart(poses)
        if len(places) > FEW:
            return ""
        delivery = PutRequest(self._stage, grip, poses, counts)
        if any(self._could_take(held, pose) for pose in places):
            return ""
        if any(True for _ in itertools.chain(delivery.drops(), delivery.ways())):
            return ""
        return delivery.reach.hindrance or placing.target

    def _could_take(self, name: str, pose: Pose) -> bool:
        """Whether the empty hand would get at a thing if it stood at a pose."""
        stage, engine = self._stage, self._world.engine
        grip, stage.grip = stage.grip, None
        engine.set_pose(name, pose)
        tracks, _, bases = ways_to(stage, name)
        found = next(stage.reach(stage.boxes(), name).ways(tracks, bases), None)
        engine.park(name)
        stage.grip = grip
        return found is not None

    def _grip(self, name: str) -> Grip | None:
        """How the hand would hold an object after it took it from where the scene has it; None when it finds no way."""
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
        tracks, _, bases = ways_to(stage, name)
        way = next(stage.reach(stage.boxes(), name).ways(tracks, bases), None)
        if way is None:
            return None
        return stage.grip_with(way.track.key_pose, world.engine.pose(name), name)

    def _make_ready(self, placing: Placing) -> None:
        """The scene as it was loaded, with the thing in the hand and the target open to it."""
        world = self._world
        world.engine.reset()
        world.hand.take(world.cargo(placing.held))
        self._stage.open_around(placing.target)
        if placing.relation is Relation.INSIDE:
            swing_panels(world.engine, world.relations, placing.target, SWING)
        world.navigator.refresh()


def _nearest(poses: Sequence[Pose], there: Pose) -> int:
    """Which of some poses is the nearest to another."""
    return min(range(len(poses)), key=lambda index: math.dist(poses[index].position_m, there.position_m))


def _apart(poses: Sequence[Pose]) -> list[Pose]:
    """The first pose at each place."""
    found: list[Pose] = []
    for pose in poses:
        if all(math.dist(pose.position_m, other.position_m) > APART_M for other in found):
            found.append(pose)
    return found
