"""Doors, drawers and lids: the hand takes the free edge and leads it along its arc, or pushes it from within."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.actions import other_stands
from embomatrix.sim.geometry.bounds import IDENTITY, joint_motion
from embomatrix.sim.physical import body
from embomatrix.sim.physical.fold import WAYS, approach, fold, unfold
from embomatrix.sim.physical.grasp import cross, facing
from embomatrix.sim.physical.hands import GENTLE, TOUCH_M
from embomatrix.sim.physical.reach import JUMP_RAD, ArmReach, Track
from embomatrix.sim.physical.reach import TOUCH_M as PRESS_M
from embomatrix.sim.physical.space import Boxes, boxes_of, part_boxes, struck
from embomatrix.sim.physical.stage import compact
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse
from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import OPEN_FRACTION

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from embomatrix.sim.physical.reach import Way
    from embomatrix.sim.physical.stage import PhysicalStage
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.asset import Asset, Joint, Link
    from embomatrix.world.geometry import FloatArray

EDGE: Final = 0.88
"""The hand takes a leaf at this share of the way from its hinge to its free edge."""
ALONG: Final = (0.0, 0.5, -0.5, 0.85)
"""Where along the edge, as shares of its half length."""
FOLLOWED: Final = (1.0, 0.5, 0.0)
"""Shares of the leaf's turn that the hand turns along."""
TILTS: Final = (0.0, 40.0, -40.0)
"""Degrees by which the hand comes from above, or from below."""
OFF_M: Final = 0.08
LEAST_OFF: Final = 0.3
"""Where the ways back and off a leaf are nearly opposite, so that their sum is shorter, the hand goes back."""
PULL: Final = 0.4
"""Share of full speed at which a leaf is led."""
WAYPOINTS: Final = 7
OVER: Final = 0.5
"""The hand goes on for this share of a waypoint's step, as leaf and arm give way a little."""
AJAR: Final = 0.2
"""A leaf that is open by more can be taken from within."""
ENOUGH: Final = 0.5
"""A door that something stops before this share of its travel is not open: the same as in cached mode."""
SHUT: Final = OPEN_FRACTION
STRETCHES: Final = (1, 2, 4)
"""Into how many pulls the way is divided, with steps between them."""
ELSEWHERE: Final = 1
"""Other standing poses that the robot tries a leaf from: there it finds other places to work."""
FAR_M: Final = 1.7
"""So far the base may go to lead a leaf."""


class GraspSpot(Enum):
    """Where the hand takes a hinged leaf: on the face that looks out when it is shut, on the other, or at its free edge."""

    OUTSIDE = "outside"
    WITHIN = "within"
    EDGE = "edge"


@dataclass(frozen=True, slots=True)
class Leaf:
    """One door, drawer or lid of an object: which joint moves it, and where the hand takes it."""

    name: str
    number: int
    link: Link
    joint: Joint
    asset: Asset
    pose: Pose
    box: Aabb
    """Around its parts, in the asset's frame with the joint at zero."""

    @property
    def height_m(self) -> float:
        """Height of its middle above the floor with the joint at zero, to the centimetre: leaves of one row are equal."""
        box = Aabb.around(part.aabb(self.pose) for part in self.link.parts)
        return round(box.center_m[2], 2)

    def at(self, fraction: float) -> Aabb:
        """Around its parts in the world, at a share of its travel."""
        frame = self.pose @ joint_motion(self.joint, fraction)
        return Aabb.around(part.aabb(frame) for part in self.link.parts)

    def grips(
        self, fraction: float, along: float, spot: GraspSpot
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Point on the leaf in the world at a share of its travel, the way out of its surface there, and the edge's line."""
        centre, half = np.array(self.box.center_m), np.array(self.box.size_m) / 2
        axis = np.array(self.joint.axis)
        if self.joint.kind is JointKind.PRISMATIC:
            out = axis * math.copysign(1.0, self.joint.upper)
            edge = np.array([out[1], -out[0], 0.0])
            point = centre + out * (np.abs(out) @ half) + along * 0.5 * edge * (np.abs(edge) @ half)
        else:
            arm = centre - np.array(self.joint.origin_m)
            free = _main_axis(arm - axis * (axis @ arm))
            face = cross(axis, free) * math.copysign(1.0, self.joint.upper)
            edge = axis
            hinge = np.array(self.joint.origin_m) @ free
            width = centre @ free + np.abs(free) @ half - hinge
            share = 1.0 if spot is GraspSpot.EDGE else EDGE
            point = (
                centre + free * (hinge + share * width - centre @ free) + along * axis * (np.abs(axis) @ half)
            )
            out = {GraspSpot.OUTSIDE: face, GraspSpot.WITHIN: -face, GraspSpot.EDGE: free}[spot]
            point = point + out * (np.abs(face) @ half) * (0.0 if spot is GraspSpot.EDGE else 1.0)
        frame = self.pose @ joint_motion(self.joint, fraction)
        turn = frame.rotation
        return np.array(frame.apply((point[0], point[1], point[2]))), turn @ out, turn @ edge


def leaves_of(stage: PhysicalStage, name: str) -> list[Leaf]:
    """The moving leaves of an object, in the order of its joints."""
    asset, pose = stage.world.asset(name), stage.world.engine.pose(name)
    moving = [link for link in asset.links if link.joint is not None]
    return [
        Leaf(
            name,
            number,
            link,
            link.joint,
            asset,
            pose,
            Aabb.around(part.aabb(IDENTITY) for part in link.parts),
        )
        for number, link in enumerate(moving)
        if link.joint is not None
    ]


def open_all(stage: PhysicalStage, name: str) -> SkillRefusal | None:
    """Open every leaf, the low ones first. It fails, and leaves what it did, when one does not get half open."""
    return _lead_all(stage, name, 1.0)


def close_all(stage: PhysicalStage, name: str) -> SkillRefusal | None:
    """Shut every leaf, the high ones first."""
    return _lead_all(stage, name, 0.0)


def _lead_all(stage: PhysicalStage, name: str, goal: float) -> SkillRefusal | None:
    if not stage.dynamic.bodies.has_leaves(name):
        return refuse(FailureReason.ARM_BLOCKED, target=name, other=name)
    home = stage.told
    refusal = None
    row = in_turn(stage, name, goal)
    # Who leads a leaf may push one that is done: those have a second turn.
    for leaf in (*row, *row):
        if _is_done(stage.dynamic.bodies.joints(name)[leaf.number], goal):
            continue
        refusal = _lead_from_anywhere(stage, leaf, goal)
        if _is_done(stage.dynamic.bodies.joints(name)[leaf.number], goal):
            refusal = None
        elif refusal is None:
            refusal = refuse(FailureReason.DOOR_BLOCKED, target=name, other=SOMETHING)
        if refusal is not None:
            break
    # Where the robot ends up does not undo what became of the door.
    fold(stage, stage.world.navigator.step_aside(name, home), name)
    return refusal


def in_turn(stage: PhysicalStage, name: str, goal: float) -> list[Leaf]:
    """The leaves of an object in the order in which they are led: to open it the low ones first, to shut it the high ones."""
    return sorted(leaves_of(stage, name), key=lambda leaf: leaf.height_m, reverse=not goal)


def _is_done(reached: float, goal: float) -> bool:
    """Whether a leaf is open, or shut, as far as cached mode asks."""
    return reached >= ENOUGH if goal else reached <= SHUT


def _lead_from_anywhere(stage: PhysicalStage, leaf: Leaf, goal: float) -> SkillRefusal | None:
    """Move one leaf to a share of its travel from here, else from where else its object is served."""
    refusal = _lead(stage, leaf, goal)
    if refusal is not None:
        for stand in itertools.islice(other_stands(stage.world, leaf.name), ELSEWHERE):
            refusal = fold(stage, stand, leaf.name) or _lead(stage, leaf, goal)
            if refusal is None:
                break
    return refusal


def _lead(stage: PhysicalStage, leaf: Leaf, goal: float) -> SkillRefusal | None:
    """Move one leaf to a share of its travel: in one stretch, else in ever more of them with steps between.

    Where it is open, or shut, far enough by then it stays: who tries for the rest may push it back.
    """
    refusal: SkillRefusal | None = None
    for stretches in STRETCHES:
        start = stage.dynamic.bodies.joints(leaf.name)[leaf.number]
        for number in range(stretches):
            now = stage.dynamic.bodies.joints(leaf.name)[leaf.number]
            aim = start + (number + 1) / stretches * (goal - start)
            refusal = _stretch(stage, leaf, now, aim) if abs(aim - now) > SHUT else None
            if refusal is not None:
                break
        if refusal is None or _is_done(stage.dynamic.bodies.joints(leaf.name)[leaf.number], goal):
            return None
    return refusal


def _stretch(stage: PhysicalStage, leaf: Leaf, start: float, goal: float) -> SkillRefusal | None:
    """Take the leaf where it is and lead it to a share of its travel."""
    reach, ways = leading(stage, leaf, start, goal)
    for way in itertools.islice(ways, WAYS):
        _draw_in(stage, way)
        swing = approach(stage, way, reach, loaded=False)
        if swing is not None and unfold(stage, swing) is None:
            return _pull(stage, way, leaf, goal)
    return refuse(FailureReason.ARM_BLOCKED, target=leaf.name, other=reach.hindrance or SOMETHING)


def leading(stage: PhysicalStage, leaf: Leaf, start: float, goal: float) -> tuple[ArmReach, Iterator[Way]]:
    """Free ways to lead a leaf from one share of its travel to another, and what judges them."""
    boxes = stage.boxes()
    fractions = np.linspace(start, goal, WAYPOINTS)
    moving = [_leaf_boxes(leaf, float(fraction)) for fraction in fractions]
    fixed = boxes.without((leaf.name,)).joined(_body_boxes(stage, leaf))
    course = np.concatenate([[0, 0], np.arange(WAYPOINTS), [WAYPOINTS - 1]]).astype(int)

    def clear(postures: FloatArray) -> bool:
        """Whether arm and trunk, but not the hand, keep clear of the leaf as it moves."""
        parts = (body.forearm_balls(postures), body.trunk_balls(postures))
        points = np.concatenate([centres for centres, _ in parts], axis=1)
        radii = np.concatenate([sizes for _, sizes in parts])
        return not any(
            struck(moving[number], points[row : row + 1], radii, PRESS_M)[0]
            for row, number in enumerate(course.tolist())
        )

    reach = ArmReach(boxes, fixed, None, clear)
    tracks = _tracks(leaf, fractions)
    first = next(tracks)
    bases = stage.bases(first.position[2], 0.75, walk_m=FAR_M)
    if goal > start:
        # The others of the object will stand open too.
        ends = [_leaf_boxes(other, goal) for other in leaves_of(stage, leaf.name)]
        bases = stage.floor.cut_off_last(bases, functools.reduce(Boxes.joined, ends))
    return reach, reach.ways(itertools.chain([first], tracks), bases)


def _draw_in(stage: PhysicalStage, way: Way) -> None:
    """Fold the arm where the last pull left it, before the base goes elsewhere: out it sweeps all that stands around."""
    now = stage.mover.posture
    if math.dist(now[:2], way.postures[0, :2]) > 0.01 and not compact(stage, now):
        fold(stage, StandPose(*now[:3].tolist()))


def _pull(stage: PhysicalStage, way: Way, leaf: Leaf, goal: float) -> SkillRefusal | None:
    """Touch the leaf, lead it along the way, let go and step back."""
    # Not what stands in the furniture: bottles in a fridge rest until something comes to them, and awake they are dear.
    stage.wake_around(leaf.at(stage.dynamic.bodies.joints(leaf.name)[leaf.number]))
    touch = way.postures[1:3]
    stage.mover.follow(touch, GENTLE, lambda: stage.dynamic.gap(leaf.name) < TOUCH_M)
    if stage.dynamic.gap(leaf.name) > 3 * TOUCH_M:
        return refuse(FailureReason.ARM_BLOCKED, target=leaf.name, other=SOMETHING)
    stage.dynamic.hook(leaf.name, leaf.number)
    hit = stage.mover.follow(way.postures[3:-1], PULL)
    if hit is None and goal in (0.0, 1.0):
        last = way.postures[-2]
        stage.mover.follow((last + OVER * (last - way.postures[-3]))[None], PULL)
    stage.mover.wait(24)
    stage.dynamic.unhook()
    stage.mover.follow(way.postures[-1:] if hit is None else _off(stage.mover.posture), 0.6)
    stage.dynamic.part()
    stage.mover.wait(4)
    if stage.dynamic.hindrance() == leaf.name and not _pushes(way.postures[-2], way.postures[-3]):
        _lean_off(stage, way, leaf)
    reached = stage.dynamic.bodies.joints(leaf.name)[leaf.number]
    stage.settle()
    if abs(reached - goal) > 0.12 and hit is not None:
        return refuse(FailureReason.DOOR_BLOCKED, target=leaf.name, other=hit or SOMETHING)
    return None


def _off(posture: FloatArray) -> FloatArray:
    """Where the hand goes off a leaf that is not led to its end: straight back, shape (1, 11); nowhere when the arm can't."""
    now = posture[None]
    rotation, position = body.tools(now)
    back = position - OFF_M * rotation[:, :, 2]
    found = body.solve(rotation, back, now[:, :3], now[:, body.LIFT], now[:, -1])[0]
    turned = np.nan_to_num(np.abs(found - posture).max(axis=1), nan=np.inf)
    return found[turned.argmin()][None] if turned.min() < JUMP_RAD else now


def _pushes(start: FloatArray, end: FloatArray) -> bool:
    """Whether the hand goes where it points between two postures, each of shape (11,): back along a pull it shuts the leaf."""
    rotation, position = body.tools(np.stack([start, end]))
    return bool((position[1] - position[0]) @ rotation[0, :, 2] > 0.0)


def _lean_off(stage: PhysicalStage, way: Way, leaf: Leaf) -> None:
    """Draw the arm back as it came, as far as it leans on the leaf and does not take the leaf along."""
    let_go = stage.dynamic.bodies.joints(leaf.name)[leaf.number]

    def is_off() -> bool:
        moved = abs(stage.dynamic.bodies.joints(leaf.name)[leaf.number] - let_go)
        return moved > SHUT or stage.dynamic.hindrance() != leaf.name

    stage.mover.follow(way.postures[-3:0:-1], 0.6, is_off)


def _tracks(leaf: Leaf, fractions: FloatArray) -> Iterator[Track]:
    """Ways of the tool: to the leaf, along its arc, and off it."""
    if leaf.joint.kind is JointKind.PRISMATIC:
        spots: tuple[GraspSpot, ...] = (GraspSpot.OUTSIDE,)
    elif fractions[0] > AJAR:
        spots = (
            (GraspSpot.EDGE, GraspSpot.OUTSIDE, GraspSpot.WITHIN)
            if fractions[-1] < fractions[0]
            else (GraspSpot.WITHIN, GraspSpot.EDGE, GraspSpot.OUTSIDE)
        )
    else:
        spots = (GraspSpot.OUTSIDE, GraspSpot.EDGE)
    turns = FOLLOWED if leaf.joint.kind is JointKind.REVOLUTE else FOLLOWED[:1]
    grips = functools.cache(leaf.grips)  # many ways go by the same points
    for spot, tilt, along, followed in itertools.product(spots, TILTS, ALONG, turns):
        yield _track(grips, fractions, along, followed, spot, tilt)


def _track(
    grips: Callable[[float, float, GraspSpot], tuple[FloatArray, FloatArray, FloatArray]],
    fractions: FloatArray,
    along: float,
    followed: float,
    spot: GraspSpot,
    tilt: float,
) -> Track:
    down = np.array([0.0, 0.0, -math.sin(math.radians(tilt))])
    start = float(fractions[0])
    rotations, positions = [], []
    for fraction in fractions.tolist():
        point, _, _ = grips(fraction, along, spot)
        _, out, edge = grips(start + followed * (fraction - start), along, spot)
        course = down - math.cos(math.radians(tilt)) * out
        course = course / np.linalg.norm(course)
        rotations.append(facing(course, 0.0 if abs(edge[2]) < 0.5 else math.pi / 2, edge))
        positions.append(point)
    first, back = grips(start, along, spot)[1], -rotations[-1][:, 2]
    # A hand that did not turn with a door lies along it in the end, and straight back it stays there; but never under a flap.
    last = back + grips(float(fractions[-1]), along, spot)[1] * (1.0, 1.0, 0.0)
    far = float(np.linalg.norm(last))
    last = last / far if far > LEAST_OFF else back
    positions = [
        positions[0] + OFF_M * first,
        positions[0] + 0.01 * first,
        positions[0] - 0.004 * first,
        *positions[1:],
        positions[-1] + OFF_M * last,
    ]
    rotations = [rotations[0], rotations[0], *rotations, rotations[-1]]
    count = len(positions)
    return Track(
        np.array(rotations), np.array(positions), np.zeros(count, dtype=bool), 2 + len(fractions) // 2
    )


def _leaf_boxes(leaf: Leaf, fraction: float) -> Boxes:
    frame = leaf.pose @ joint_motion(leaf.joint, fraction)
    return boxes_of([(frame @ part.pose, part.size_m, leaf.name) for part in leaf.link.parts])


def _body_boxes(stage: PhysicalStage, leaf: Leaf) -> Boxes:
    """The object's parts but those of the leaf."""
    fractions = stage.world.engine.joints(leaf.name)
    parts = part_boxes(leaf.asset, leaf.pose, fractions)
    owners = [link for link in leaf.asset.links for _ in link.parts]
    return boxes_of(
        [
            (pose, size, leaf.name)
            for (pose, size), link in zip(parts, owners, strict=True)
            if link.name != leaf.link.name
        ]
    )


def _main_axis(vector: FloatArray) -> FloatArray:
    """The coordinate axis that a vector points along most."""
    found = np.zeros(3)
    number = int(np.abs(vector).argmax())
    found[number] = math.copysign(1.0, vector[number])
    return found
