"""Looking ahead at placing, offline: at which verified poses the arm gets with what it holds, and what bars it from all.

Cached mode and physical mode then prefer the same poses, those that the arm was seen to get at, and a thing ends at the same
place in both.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.sim.leaves import Leaves
from embomatrix.sim.physical.hands import ways_to
from embomatrix.sim.physical.place import PLACES
from embomatrix.sim.physical.put import Delivery
from embomatrix.sim.physical.stage import tucked
from embomatrix.sim.placement import Placer
from embomatrix.sim.swings import SWING
from embomatrix.skills.failure import FailureReason
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from embomatrix.sim.physical.stage import Grip, Stage
    from embomatrix.world.poses import PoseCache, StandPose

LOOKS: Final = 6
"""Poses of one thing at one target that are looked at."""
WANTED: Final = 2
"""So many that the arm gets at are enough."""
MOST_LOOKS: Final = 400
"""Looks in one scene: the first targets that are asked about get them."""
TRIALS: Final = 12
"""Targets that look out of reach of which it is made sure that no hold and no other pose leads there."""


@dataclass(frozen=True, slots=True)
class Placing:
    """One object put in a relation to another."""

    held: str
    target: str
    relation: Relation


class Prospects:
    """Asks the arm about places in a scene as it was loaded. Nothing is stepped."""

    def __init__(self, stage: Stage, poses: PoseCache) -> None:
        """``poses`` are placements and standing poses of the stage's scene."""
        self._stage = stage
        self._world = stage.world
        self._poses = poses
        self._placer = Placer(stage.world.engine, stage.world.relations, poses)
        self._grips: dict[str, Grip | None] = {}
        self._looks = 0
        self._trials = 0

    def seen(self, placings: Iterable[Placing]) -> PoseCache:
        """The poses with what was found out about placing these, the first of them as long as it lasts."""
        reached: dict[Relation, dict[str, dict[str, tuple[int, ...]]]] = {}
        barred: dict[Relation, dict[str, dict[str, str]]] = {}
        for placing in placings:
            if self._looks >= MOST_LOOKS:
                break
            numbers, other = self._look(placing)
            if numbers:
                reached.setdefault(placing.relation, {}).setdefault(placing.held, {})[placing.target] = (
                    numbers
                )
            if other:
                barred.setdefault(placing.relation, {}).setdefault(placing.held, {})[placing.target] = other
        return replace(self._poses, reached=reached, barred_places=barred)

    def _look(self, placing: Placing) -> tuple[tuple[int, ...], str]:
        """Numbers of poses that the arm gets at, and what bars the way to all when it is sure that it gets at none."""
        stands = self._poses.stands.get(placing.target, ())
        if not stands or not self._placer.knows(placing.held, placing.target, placing.relation):
            return (), ""
        grip = self._grip(placing.held)
        if grip is None:
            return (), ""
        self._make_ready(placing)
        poses = self._placer.verified(placing.held, placing.target, placing.relation, stands[0], LOOKS)
        if not poses:
            return (), ""
        self._stand_at(stands[0])
        self._stage.grip = grip

        def counts() -> bool:
            return self._world.relations.holds(placing.relation, placing.held, placing.target)

        delivery = Delivery(self._stage, grip, [pose for _, pose in poses], counts)
        found = self._reached(poses, delivery.reaches) or self._reached(poses, delivery.reaches_turned)
        other = "" if found else self._bars(placing, grip, stands[0], counts)
        self._stage.grip = None
        return found, other

    def _reached(self, poses: Sequence[tuple[int, Pose]], reaches: Callable[[Pose], bool]) -> tuple[int, ...]:
        """Numbers of the first poses that the arm gets at, as many as are wanted."""
        found: list[int] = []
        for number, pose in poses:
            self._looks += 1
            if reaches(pose):
                found.append(number)
            if len(found) == WANTED:
                break
        return tuple(found)

    def _bars(self, placing: Placing, grip: Grip, stand: StandPose, counts: Callable[[], bool]) -> str:
        """What bars the way to every pose; "" when one may lead there with some hold, or too much was tried already.

        Where the hand could not take a thing from it can't put it, however it holds it, nor can it let it fall from above.
        """
        if self._trials == TRIALS:
            return ""
        self._trials += 1
        held = placing.held
        poses = self._placer.choices(held, placing.target, placing.relation, stand, most=PLACES)
        if isinstance(poses, FailureReason):
            return ""
        delivery = Delivery(self._stage, grip, poses, counts)
        if any(self._could_take(held, pose) for pose in poses):
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
        self._open_around(name)
        self._stand_at(stands[0])
        tracks, _, bases = ways_to(stage, name)
        way = next(stage.reach(stage.boxes(), name).ways(tracks, bases), None)
        if way is None:
            return None
        key = way.track.key
        tool = Pose.from_rotation(tuple(way.track.position[key].tolist()), way.track.rotation[key])
        return stage.grip_with(tool, world.engine.pose(name), name)

    def _make_ready(self, placing: Placing) -> None:
        """The scene as it was loaded, with the thing in the hand and the target open to it."""
        world = self._world
        world.engine.reset()
        world.hand.take(world.cargo(placing.held))
        self._open_around(placing.target)
        if placing.relation is Relation.INSIDE:
            self._open(placing.target)
        world.navigator.refresh()

    def _open_around(self, name: str) -> None:
        for enclosure in self._world.relations.enclosing(name):
            if enclosure.closed:
                self._open(enclosure.name)
        self._world.navigator.refresh()

    def _open(self, name: str) -> None:
        engine = self._world.engine
        leaves = Leaves(engine, self._world.relations, name)
        leaves.swing([(share,) * len(engine.joints(name)) for share in SWING])

    def _stand_at(self, stand: StandPose) -> None:
        self._world.robot = self._stage.told = stand
        self._stage.dynamic.robot.appear(tucked(stand))
