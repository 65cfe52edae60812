"""Search for poses of one held object on, in or under another, in the engine's present state."""

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.engine import FLOOR, TOLERANCE_M, PhysicsEngine
from embomatrix.sim.floor.navigation import has_front
from embomatrix.sim.geometry.batch_poses import (
    HANDY,
    REACHED,
    BoolArray,
    Neighbours,
    PoseBoxes,
    Range,
)
from embomatrix.sim.geometry.behind_panels import behind_panels
from embomatrix.sim.geometry.statics import is_level, rest_pose
from embomatrix.sim.geometry.surfaces import is_shut, link_frame, links_with_surfaces
from embomatrix.sim.placing.loaded_places import NOTHING_NEAR_M, LoadedPlaces, MovedObjects
from embomatrix.sim.placing.options import CandidatePoses, PlacementOptions
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation

UNDISTURBED_M: Final = 0.005
"""A pose verified offline is settled again if anything but its support is this near."""
NEAR_M: Final = UNDISTURBED_M + TOLERANCE_M
"""Margin for penetration queries at this distance, which subtract the tolerance."""
LIVE_TRIES: Final = 64
"""Candidates tried beyond the cached ones."""
EXAMINED: Final = 12
"""Places of each set that are examined for the object in the way."""
STANDS_KEPT: Final = 8
"""Standing poses for which a set of known places remembers the ones in reach."""
LIVE_SETTLES: Final = 8
"""Most of these candidates that are simulated."""
HIGH_RIM_M: Final = ROBOT.reach_high_m - ROBOT.extent_m / 2
"""Highest rim over which the arm lifts any object it can hold."""


Corner = Sequence[float]
"""Low corner of a box, then its high corner."""


@dataclass(frozen=True)
class PlacementSearch:
    """Search for poses of an object with a relation to a target, in reach of a standing pose.

    A found pose has the relation, penetrates nothing, is within the robot's reach and is stable. Poses within reach of
    ``excluded_stands`` are skipped. The search moves the held object and leaves it where it was tried last.
    """

    engine: PhysicsEngine
    relations: Relations
    options: PlacementOptions
    moved: MovedObjects
    held: str
    target: str
    relation: Relation
    robot: StandPose
    excluded_stands: tuple[StandPose, ...] = ()

    def poses(self, rng: np.random.Generator | None, reached: int | None) -> Iterator[Pose]:
        """Accepted poses: verified for the pair, then for the footprint class, then fresh ones.

        The pose with the number ``reached`` comes first in the first set. Without ``rng`` the cache's order holds.
        """
        for options in self.options.verified(self.held, self.target, self.relation):
            order = range(len(options)) if rng is None else rng.permutation(len(options)).tolist()
            if reached is not None and reached < len(options):
                yield from (pose for _, pose in self.accepted(options, [reached]))
                order = [number for number in order if number != reached]
            for _, pose in self.accepted(options, order):
                yield pose
            reached = None
        yield from self._fresh(rng)

    def accepted(self, options: CandidatePoses, order: Sequence[int]) -> Iterator[tuple[int, Pose]]:
        """Accepted poses of a verified set, each with its number."""
        for number, nearest in self._roomy_first(options, order):
            pose = options.pose(number, self._frames)
            found = self._lonely(pose) if nearest is None else self._verified(pose, nearest)
            if found is not None:
                yield number, found

    def _known(self, options: CandidatePoses) -> LoadedPlaces | None:
        """Places that were looked at in the scene as loaded, if the target has not moved since."""
        engine, held, target = self.engine, self.held, self.target
        known = options.as_loaded.get((target, self.relation, engine.joints(held), engine.joints(target)))
        if known is None or engine.pose(target) != engine.scene.by_name[target].pose_world_asset:
            return None
        return known

    def _lonely(self, pose: Pose) -> Pose | None:
        """Accept a pose that was verified, with nothing but its support near it."""
        engine, held, target = self.engine, self.held, self.target
        # The pose was verified with all joints shut: while they are, the object is free of its support.
        if any((*engine.joints(target), *engine.joints(held))):
            engine.set_pose(held, pose)
            if self._is_deep(target):
                return None
        if self._holds(pose):
            return pose
        engine.set_pose(held, pose)
        return self._settled()

    def _fresh(self, rng: np.random.Generator | None) -> Iterator[Pose]:
        """Poses for pairs that the analysis did not cover, and on surfaces that have filled up."""
        shift = (0.5, 0.5) if rng is None else (float(rng.random()), float(rng.random()))
        options = self.options.fresh(self.held, self.target, self.relation, shift, LIVE_TRIES)
        settles = 0
        for number, nearest in self._roomy_first(options, range(len(options))):
            if settles == LIVE_SETTLES:
                return
            found = self._proved(options, number)
            if found is None:
                pose = options.pose(number, self._frames)
                if not self._is_free(pose, nearest or "") or not self._holds():
                    continue
                settles += 1
                found = self._settled()
            if found is not None:
                yield found

    def hindrance(self) -> tuple[FailureReason, str]:
        """Reason why no pose is accepted, and the object in the way at most of the places; "" if none is to blame."""
        met = Counter[str]()
        is_reached, is_served = False, False
        fresh = self.options.fresh(self.held, self.target, self.relation, (0.5, 0.5), LIVE_TRIES)
        for options in (*self.options.verified(self.held, self.target, self.relation), fresh):
            if not len(options):
                continue
            boxes = options.places.world_boxes(self.engine.joints(self.held), self._frames)
            served = np.flatnonzero(self.serves(boxes, self.robot)).tolist()
            is_reached |= bool(boxes.reached_from(self.robot).any())
            is_served |= bool(served)
            for number in served[:EXAMINED]:
                self.engine.set_pose(self.held, options.pose(number, self._frames))
                met[self.engine.penetrates(self.held)] += 1
        if not is_served:
            hidden = is_reached and any(self.engine.joints(self.target))
            return FailureReason.PLACES_BEHIND_DOOR if hidden else FailureReason.PLACES_OUT_OF_REACH, ""
        # Ties go to the first by name: the answer is part of the trace.
        others = sorted(met.keys() - {"", self.target})
        return FailureReason.NO_FREE_POSE, max(others, key=lambda name: met[name], default="")

    def _roomy_first(self, options: CandidatePoses, order: Sequence[int]) -> Iterator[tuple[int, str | None]]:
        """Candidates in reach: first those with nothing but the target around, then the others; handy ones lead each group.

        Each of the others comes with the object it most likely meets, and the first ones with "", or None if no wall is near
        either. This coarse test uses boxes only; candidates that certainly collide are left out. They are tested one after the
        other, because most callers take the first.
        """
        if not order:
            return
        known, ignore = self._known(options), frozenset((self.held, self.target))
        if known is not None:
            boxes, is_crowded = known.boxes, self._crowding(known, ignore)
        else:
            boxes = options.places.world_boxes(self.engine.joints(self.held), self._frames)
            is_crowded = self._crowding_of(boxes, ignore)
        rows: list[int] = []
        crowded: list[int] = []
        for number, corner in self._handy_first(known, boxes, order, rows):
            found = is_crowded(number, corner)
            if found:
                crowded.append(number)
            else:
                yield number, None if found is None else ""
        if not crowded:
            return
        near = self.engine.near(boxes.at(rows).around().grown(NEAR_M), ignore)
        taken, most = boxes.at(crowded).overlaps(_neighbours(self.engine, near))
        for number, full, nearest in zip(crowded, taken.tolist(), most.tolist(), strict=True):
            if not full:
                yield number, near[nearest]

    def _crowding(self, known: LoadedPlaces, ignore: frozenset[str]) -> Callable[[int, Corner], bool | None]:
        """Return a test of one place for objects around it. It answers None if no wall is near either."""
        lonely, moved, near = known.table[:, 6].tolist(), self.moved.boxes(ignore), self.engine.near

        def is_crowded(number: int, corner: Corner) -> bool | None:
            a, b, c, d, e, f = corner
            box = Aabb((a, b, c), (d, e, f))
            if lonely[number] and not any(box.overlaps(other, NOTHING_NEAR_M) for other in moved):
                return None
            return bool(near(box.grown(NEAR_M), ignore))

        return is_crowded

    def _crowding_of(self, boxes: PoseBoxes, ignore: frozenset[str]) -> Callable[[int, Corner], bool]:
        """Return a test of one place for objects around it, which looks at all places at once."""
        valid = boxes.finite()
        if not len(valid.lows_m):
            return lambda number, corner: False
        near = self.engine.near(valid.around().grown(NEAR_M), ignore)
        crowded = boxes.meet([self.engine.aabb(name) for name in near], NEAR_M).tolist()
        return lambda number, corner: bool(crowded[number])

    def _handy_first(
        self, known: LoadedPlaces | None, boxes: PoseBoxes, order: Sequence[int], rows: list[int]
    ) -> Iterator[tuple[int, Corner]]:
        """Numbers and corners of the boxes in reach, handy ones first. ``rows`` receives the numbers as they are tested."""
        if self.excluded_stands:
            reached = self.serves(boxes, self.robot)
            for stand in self.excluded_stands:
                reached &= ~self.serves(boxes, stand)
            served: Sequence[bool] = reached.tolist()
            order = [number for number in order if served[number]]
        elif self._rises_over_rim or any(self.engine.joints(self.target)):
            served = self.served(known) if known is not None else self.serves(boxes, self.robot).tolist()
            order = [number for number in order if served[number]]
        corners = boxes.corners()
        reach, easy = Range.of(self.robot, *REACHED), Range.of(self.robot, *HANDY)
        others: list[int] = []
        for number in order:
            corner = corners[number]
            if reach.includes(corner):
                rows.append(number)
                if easy.includes(corner):
                    yield number, corner
                else:
                    others.append(number)
        for number in others:
            yield number, corners[number]

    def served(self, known: LoadedPlaces) -> Sequence[bool]:
        """Tell for each known place if the arm reaches it. The robot stands at few places beside an open support."""
        memory = known.served
        found = memory.get(self.robot) if memory is not None else None
        if found is None:
            found = tuple(self.serves(known.boxes, self.robot).tolist())
            if memory is not None:
                if len(memory) >= STANDS_KEPT:
                    memory.clear()
                memory[self.robot] = found
        return found

    def serves(self, boxes: PoseBoxes, stand: StandPose) -> BoolArray:
        """Tell for each box, shape (n,), if the arm reaches it over the target's rim and past its open doors."""
        engine, asset, fractions = self.engine, self._asset(self.target), self.engine.joints(self.target)
        reached = boxes.reached_from(stand)
        if self._rises_over_rim:
            reached &= boxes.raised_over(engine.aabb(self.target).high_m[2]).reached_from(stand)
        if any(fractions):
            around = self.options.barriers[asset.asset_id, engine.pose(self.target), fractions]
            if around:
                reached &= ~behind_panels(boxes, around, stand)
        return reached

    @functools.cached_property
    def _rises_over_rim(self) -> bool:
        """Return True if the arm lifts the object over the target's rim, which limits its reach."""
        rim_m = self.engine.aabb(self.target).high_m[2]
        return (
            self.relation is Relation.INSIDE
            and rim_m > HIGH_RIM_M
            and not has_front(self._asset(self.target))
        )

    @functools.cached_property
    def _frames(self) -> dict[str, Pose]:
        return link_frames(self.engine, self.target, self.relation)

    def _asset(self, name: str) -> Asset:
        return self.engine.scene.asset_of(name)

    def _verified(self, pose: Pose, nearest: str) -> Pose | None:
        """Accept a pose that was verified with nothing but its support around; settle it if anything else is near."""
        engine, held, target = self.engine, self.held, self.target
        engine.set_pose(held, pose)
        if nearest and self._is_deep(nearest):
            return None
        other = engine.penetrates(held, NEAR_M, frozenset((target, FLOOR)))
        if other in engine.scene.by_name and self._is_deep(other):
            return None
        if other:
            return None if engine.penetrates(held) else self._settled()
        # The pose was verified with all joints shut: while they are, the object is free of its support.
        if any((*engine.joints(target), *engine.joints(held))) and self._is_deep(target):
            return None
        return pose if self._holds() else self._settled()

    def _proved(self, options: CandidatePoses, number: int) -> Pose | None:
        """Rest pose by statics with nothing but the support within 5 mm; None if only a settle can decide."""
        engine, held, target = self.engine, self.held, self.target
        one, other = self._asset(held), self._asset(target)
        base, link = self.options.bases[one.asset_id], options.link(number)
        if base is None or not is_level(self._frames[link]):
            return None
        fractions = engine.joints(target)
        start = link_frame(other, IDENTITY, fractions, link) @ options.exact(number)
        rest = rest_pose(one, base, start, other, fractions)
        if rest is None:
            return None
        pose = engine.pose(target) @ rest
        x, y, z = pose.position_m
        # Checked slightly higher, out of range of objects below the support, such as the table under a sheet.
        engine.set_pose(held, Pose((x, y, z + NEAR_M), pose.quat_xyzw))
        if engine.penetrates(held, NEAR_M, frozenset((target, FLOOR))):
            return None
        engine.set_pose(held, pose)
        return pose if self._holds() and self._reaches() else None

    def _settled(self) -> Pose | None:
        """Let the object settle and accept the pose if all conditions still hold."""
        settled = self.engine.settle(self.held)
        if not settled.stable or not self._is_free(settled.pose, "") or not self._reaches():
            return None
        return settled.pose if self._holds() else None

    def _holds(self, pose: Pose | None = None) -> bool:
        """Return True if the relation holds at ``pose``, or where the object is tried now."""
        match self.relation:
            case Relation.ONTOP:
                return self.relations.supports.would_be_on(self.held, self.target, pose)
            case Relation.INSIDE:
                return self.relations.supports.would_be_in(self.held, self.target, pose)
            case _:
                if pose is not None:
                    self.engine.set_pose(self.held, pose)
                return self.relations.holds(self.relation, self.held, self.target)

    def _is_free(self, pose: Pose, nearest: str) -> bool:
        """Put the object at the pose. Return True if it penetrates nothing; ``nearest`` is checked first."""
        self.engine.set_pose(self.held, pose)
        return not (nearest and self._is_deep(nearest)) and not self.engine.penetrates(self.held)

    def _is_deep(self, other: str) -> bool:
        gap_m = self.engine.gap(self.held, other, 0.0)
        return gap_m is not None and gap_m < -TOLERANCE_M

    def _reaches(self) -> bool:
        return in_reach(self.engine.aabb(self.held), self.robot)


def link_frames(engine: PhysicsEngine, target: str, relation: Relation) -> dict[str, Pose]:
    """Frame of each link of the target that can carry objects; shut drawers are left out."""
    asset, pose, fractions = engine.scene.asset_of(target), engine.pose(target), engine.joints(target)
    if not fractions:
        return {"": pose}
    shut = {
        item.link
        for item in asset.interiors
        if item.link and relation is Relation.INSIDE and is_shut(asset, item, fractions)
    }
    links = ({""} | links_with_surfaces(asset)) - shut
    return {link: link_frame(asset, pose, fractions, link) for link in sorted(links)}


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Return True if the arm reaches the nearest point of a box in the plane, and the height of its middle."""
    near = box.level_distance_m(robot.x_m, robot.y_m) <= ROBOT.reach_m
    return near and ROBOT.reach_low_m <= box.center_m[2] <= ROBOT.reach_high_m


def _neighbours(engine: PhysicsEngine, names: Sequence[str]) -> Neighbours:
    items = [engine.scene.by_name[name] for name in names]
    links = [engine.scene.assets[item.asset_id].links for item in items]
    return Neighbours.of(
        [engine.aabb(name) for name in names],
        [len(chain) == 1 and len(chain[0].parts) == 1 for chain in links],
        [not item.fixed for item in items],
    )
