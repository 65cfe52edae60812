"""Doors, drawers and lids: the hand takes the free edge of a panel and pulls it along its arc, or pushes it from within."""

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from embomatrix.sim.actions import other_stands
from embomatrix.sim.blockers import obstacle_in_words
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.sim.joints.swings import LEAST_OPEN
from embomatrix.sim.physical import body
from embomatrix.sim.physical.fold import PATHS_TRIED, approach, fold, unfold
from embomatrix.sim.physical.grasp import cross, facing
from embomatrix.sim.physical.pick import GENTLE_PACE, TOUCH_M
from embomatrix.sim.physical.reach import JUMP_RAD, ArmPath, ArmReach, ToolPath
from embomatrix.sim.physical.reach import TOUCH_M as PRESS_M
from embomatrix.sim.physical.space import Boxes, boxes_of, collides, part_boxes
from embomatrix.sim.physical.stage import PhysicalStage, compact
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.asset import Asset, Joint, JointKind, Link
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import OPEN_FRACTION

EDGE: Final = 0.88
"""Grip point on a hinged panel, as a share of the distance from its hinge to its free edge."""
ALONG: Final = (0.0, 0.5, -0.5, 0.85)
"""Grip points along the edge, as shares of its half length."""
FOLLOWED: Final = (1.0, 0.5, 0.0)
"""Shares of the panel's rotation that the hand follows."""
TILTS: Final = (0.0, 40.0, -40.0)
"""Angles, in degrees, from which the hand comes: level, from above, from below."""
OFF_M: Final = 0.08
LEAST_OFF: Final = 0.3
"""If the directions back and off a panel are nearly opposite, so that their sum is shorter than this, the hand goes back."""
PULL_PACE: Final = 0.4
"""Share of full speed at which the hand moves a panel."""
WAYPOINTS: Final = 7
OVER: Final = 0.5
"""Share of a waypoint step by which the hand overshoots, because panel and arm yield a little."""
AJAR: Final = 0.2
"""A panel that is open by more than this share can be gripped from within."""
SHUT: Final = OPEN_FRACTION
STRETCHES: Final = (1, 2, 4)
"""Numbers of pulls into which a motion is divided. The robot repositions itself between pulls."""
ELSEWHERE: Final = 1
"""Other standing poses from which the robot tries to move a panel."""
BACK_STEPS: Final = 360
"""Steps of 1/240 s in which panels swing back after a failure."""
FAR_M: Final = 1.7
"""Longest distance that the base may drive to move a panel."""


class GraspSpot(Enum):
    """Grip spot on a hinged panel: the face that looks out when it is shut, the inner face, or the free edge."""

    OUTSIDE = "outside"
    WITHIN = "within"
    EDGE = "edge"


@dataclass(frozen=True, slots=True)
class DoorPanel:
    """One door, drawer or lid of an object, with its joint. A part of the object `name`."""

    name: str
    number: int
    link: Link
    joint: Joint
    asset: Asset
    pose: Pose
    box: Aabb
    """Box around the panel's parts, in the asset's frame with the joint at zero."""

    @property
    def height_m(self) -> float:
        """Height of the panel's centre above the floor with the joint at zero. Centimetres make panels of one row equal."""
        box = Aabb.around(part.aabb(self.pose) for part in self.link.parts)
        return round(box.center_m[2], 2)

    def at(self, fraction: float) -> Aabb:
        """Box around the panel in the world at a share of its travel."""
        frame = self.pose @ joint_motion(self.joint, fraction)
        return Aabb.around(part.aabb(frame) for part in self.link.parts)

    def grips(
        self, fraction: float, along: float, spot: GraspSpot
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return grip point, outward surface normal and edge direction in the world at a share of the travel."""
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


def panels_of(stage: PhysicalStage, name: str) -> list[DoorPanel]:
    """Return the moving panels of an object, in the order of its joints."""
    asset, pose = stage.world.asset(name), stage.world.engine.pose(name)
    moving = [(link, link.joint) for link in asset.links if link.joint is not None]
    return [
        DoorPanel(
            name,
            number,
            link,
            joint,
            asset,
            pose,
            Aabb.around(part.aabb(IDENTITY) for part in link.parts),
        )
        for number, (link, joint) in enumerate(moving)
    ]


def move_panels(stage: PhysicalStage, name: str, goal: float) -> SkillRefusal | None:
    """Open every panel, the low ones first (``goal`` 1), or shut every panel, the high ones first (``goal`` 0).

    Fails if a panel does not get half open, or shut. All panels of the object then swing back to where they were.
    """
    if not stage.dynamic.bodies.has_panels(name):
        return refuse(FailureReason.ARM_BLOCKED, target=name, other=name)
    home, before = stage.commanded, stage.dynamic.bodies.joints(name)
    refusal = None
    row = panels_in_order(stage, name, goal)
    # Moving one panel may push another that is done: such panels get a second turn.
    for panel in (*row, *row):
        if _is_done(_fraction(stage, panel), goal):
            continue
        refusal = _move_from_anywhere(stage, panel, goal)
        if _is_done(_fraction(stage, panel), goal):
            refusal = None
        elif refusal is None:
            refusal = refuse(FailureReason.DOOR_BLOCKED, target=name, other=SOMETHING)
        if refusal is not None:
            break
    # The refusal of this drive does not matter: the door's result stands.
    fold(stage, stage.world.navigator.step_aside(name, home), name)
    if refusal is not None:
        stage.dynamic.bodies.swing_back(name, before)
        stage.mover.wait(BACK_STEPS)
        stage.dynamic.bodies.brake(name)
        stage.settle()
        other = stage.world.swings.obstacle(name, goal)
        if refusal.reason is FailureReason.DOOR_BLOCKED and other:
            refusal = refuse(FailureReason.DOOR_BLOCKED, target=name, other=obstacle_in_words(other))
    return refusal


def panels_in_order(stage: PhysicalStage, name: str, goal: float) -> list[DoorPanel]:
    """Return the panels of an object in the order of motion: low ones first to open, high ones first to shut."""
    return sorted(panels_of(stage, name), key=lambda panel: panel.height_m, reverse=not goal)


def _fraction(stage: PhysicalStage, panel: DoorPanel) -> float:
    """Share of its travel that a panel is open in the dynamic world."""
    return stage.dynamic.bodies.joints(panel.name)[panel.number]


def _is_done(reached: float, goal: float) -> bool:
    """True if a panel is open, or shut, by the standard of cached mode."""
    return reached >= LEAST_OPEN if goal else reached <= SHUT


def _move_from_anywhere(stage: PhysicalStage, panel: DoorPanel, goal: float) -> SkillRefusal | None:
    """Move one panel to a share of its travel from here, else from other standing poses."""
    refusal = _move_panel(stage, panel, goal)
    if refusal is not None:
        for stand in itertools.islice(other_stands(stage.world, panel.name), ELSEWHERE):
            refusal = fold(stage, stand, panel.name) or _move_panel(stage, panel, goal)
            if refusal is None:
                break
    return refusal


def _move_panel(stage: PhysicalStage, panel: DoorPanel, goal: float) -> SkillRefusal | None:
    """Move one panel to a share of its travel in one pull, else in more and more pulls with steps between them.

    A panel that is open, or shut, far enough stays there: another attempt may push it back.
    """
    refusal: SkillRefusal | None = None
    for stretches in STRETCHES:
        start = _fraction(stage, panel)
        for number in range(stretches):
            now = _fraction(stage, panel)
            aim = start + (number + 1) / stretches * (goal - start)
            refusal = _stretch(stage, panel, now, aim) if abs(aim - now) > SHUT else None
            if refusal is not None:
                break
        if refusal is None or _is_done(_fraction(stage, panel), goal):
            return None
    return refusal


def _stretch(stage: PhysicalStage, panel: DoorPanel, start: float, goal: float) -> SkillRefusal | None:
    """Grip the panel at its present position and move it to a share of its travel."""
    reach, paths = panel_paths(stage, panel, start, goal)
    for path in itertools.islice(paths, PATHS_TRIED):
        _draw_in(stage, path)
        swing = approach(stage, path, reach, loaded=False)
        if swing is not None and unfold(stage, swing) is None:
            return _pull(stage, path, panel, goal)
    return refuse(FailureReason.ARM_BLOCKED, target=panel.name, other=reach.blocker or SOMETHING)


def panel_paths(
    stage: PhysicalStage, panel: DoorPanel, start: float, goal: float
) -> tuple[ArmReach, Iterator[ArmPath]]:
    """Return free paths that move a panel from one share of its travel to another, and the reach that judges them."""
    boxes = stage.boxes()
    fractions = np.linspace(start, goal, WAYPOINTS)
    moving = [_panel_boxes(panel, float(fraction)) for fraction in fractions]
    fixed = boxes.without((panel.name,)).joined(_body_boxes(stage, panel))
    course = np.concatenate([[0, 0], np.arange(WAYPOINTS), [WAYPOINTS - 1]]).astype(int)

    def clear(postures: FloatArray) -> bool:
        """True if arm and trunk, without the hand, keep clear of the moving panel."""
        parts = (body.forearm_balls(postures), body.trunk_balls(postures))
        points = np.concatenate([centres for centres, _ in parts], axis=1)
        radii = np.concatenate([sizes for _, sizes in parts])
        return not any(
            collides(moving[number], points[row : row + 1], radii, PRESS_M)[0]
            for row, number in enumerate(course.tolist())
        )

    reach = ArmReach(boxes, fixed, None, clear)
    tool_paths = _tool_paths(panel, fractions)
    first = next(tool_paths)
    bases = stage.bases(first.position[2], 0.75, walk_m=FAR_M)
    if goal > start:
        # The other panels of the object will be open too.
        ends = [_panel_boxes(other, goal) for other in panels_of(stage, panel.name)]
        bases = stage.floor.with_cut_off_last(bases, functools.reduce(Boxes.joined, ends))
    return reach, reach.paths(itertools.chain([first], tool_paths), bases)


def _draw_in(stage: PhysicalStage, path: ArmPath) -> None:
    """Fold the arm before the base drives elsewhere: an arm left out after a pull sweeps over everything around."""
    now = stage.mover.posture
    if math.dist(now[:2], path.postures[0, :2]) > 0.01 and not compact(stage, now):
        fold(stage, StandPose(*now[:3].tolist()))


def _pull(stage: PhysicalStage, path: ArmPath, panel: DoorPanel, goal: float) -> SkillRefusal | None:
    """Touch the panel, move it along the path, let go and step back."""
    # Contents stay asleep until something touches them: awake bottles in a fridge cost much time.
    stage.wake_around(panel.at(_fraction(stage, panel)))
    touch = path.postures[1:3]
    stage.mover.follow(touch, GENTLE_PACE, lambda: stage.dynamic.gap(panel.name) < TOUCH_M)
    if stage.dynamic.gap(panel.name) > 3 * TOUCH_M:
        return refuse(FailureReason.ARM_BLOCKED, target=panel.name, other=SOMETHING)
    stage.dynamic.hook(panel.name, panel.number)
    hit = stage.mover.follow(path.postures[3:-1], PULL_PACE)
    if hit is None and goal in (0.0, 1.0):
        last = path.postures[-2]
        stage.mover.follow((last + OVER * (last - path.postures[-3]))[None], PULL_PACE)
    stage.mover.wait(24)
    stage.dynamic.unhook()
    stage.mover.follow(path.postures[-1:] if hit is None else _off(stage.mover.posture), 0.6)
    stage.dynamic.part()
    stage.mover.wait(4)
    if stage.dynamic.hindrance() == panel.name and not _pushes(path.postures[-2], path.postures[-3]):
        _lean_off(stage, path, panel)
    reached = _fraction(stage, panel)
    stage.settle()
    if abs(reached - goal) > 0.12 and hit is not None:
        return refuse(FailureReason.DOOR_BLOCKED, target=panel.name, other=hit or SOMETHING)
    return None


def _off(posture: FloatArray) -> FloatArray:
    """Return the posture, (1, 11), with the hand drawn straight back; the present posture if the arm can't."""
    now = posture[None]
    rotation, position = body.tools(now)
    back = position - OFF_M * rotation[:, :, 2]
    found = body.solve(rotation, back, now[:, :3], now[:, body.LIFT], now[:, -1])[0]
    turned = np.nan_to_num(np.abs(found - posture).max(axis=1), nan=np.inf)
    return found[turned.argmin()][None] if turned.min() < JUMP_RAD else now


def _pushes(start: FloatArray, end: FloatArray) -> bool:
    """True if the hand moves in its pointing direction between two postures, each of shape (11,)."""
    rotation, position = body.tools(np.stack([start, end]))
    return bool((position[1] - position[0]) @ rotation[0, :, 2] > 0.0)


def _lean_off(stage: PhysicalStage, path: ArmPath, panel: DoorPanel) -> None:
    """Draw the arm back along its path until it no longer leans on the panel, unless it takes the panel along."""
    let_go = _fraction(stage, panel)

    def is_off() -> bool:
        moved = abs(_fraction(stage, panel) - let_go)
        return moved > SHUT or stage.dynamic.hindrance() != panel.name

    stage.mover.follow(path.postures[-3:0:-1], 0.6, is_off)


def _tool_paths(panel: DoorPanel, fractions: FloatArray) -> Iterator[ToolPath]:
    """Yield tool paths to the panel, along its arc, and off it."""
    if panel.joint.kind is JointKind.PRISMATIC:
        spots: tuple[GraspSpot, ...] = (GraspSpot.OUTSIDE,)
    elif fractions[0] > AJAR:
        spots = (
            (GraspSpot.EDGE, GraspSpot.OUTSIDE, GraspSpot.WITHIN)
            if fractions[-1] < fractions[0]
            else (GraspSpot.WITHIN, GraspSpot.EDGE, GraspSpot.OUTSIDE)
        )
    else:
        spots = (GraspSpot.OUTSIDE, GraspSpot.EDGE)
    turns = FOLLOWED if panel.joint.kind is JointKind.REVOLUTE else FOLLOWED[:1]
    grips = functools.cache(panel.grips)  # many paths share points
    for spot, tilt, along, followed in itertools.product(spots, TILTS, ALONG, turns):
        yield _tool_path(grips, fractions, along, followed, spot, tilt)


def _tool_path(
    grips: Callable[[float, float, GraspSpot], tuple[FloatArray, FloatArray, FloatArray]],
    fractions: FloatArray,
    along: float,
    followed: float,
    spot: GraspSpot,
    tilt: float,
) -> ToolPath:
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
    # A hand that did not turn with a door lies along it at the end, so it must leave sideways too, but never under a flap.
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
    return ToolPath(
        np.array(rotations), np.array(positions), np.zeros(count, dtype=bool), 2 + len(fractions) // 2
    )


def _panel_boxes(panel: DoorPanel, fraction: float) -> Boxes:
    frame = panel.pose @ joint_motion(panel.joint, fraction)
    return boxes_of([(frame @ part.pose, part.size_m, panel.name) for part in panel.link.parts])


def _body_boxes(stage: PhysicalStage, panel: DoorPanel) -> Boxes:
    """Boxes of the object's parts without the panel."""
    fractions = stage.world.engine.joints(panel.name)
    parts = part_boxes(panel.asset, panel.pose, fractions)
    owners = [link for link in panel.asset.links for _ in link.parts]
    return boxes_of(
        [
            (pose, size, panel.name)
            for (pose, size), link in zip(parts, owners, strict=True)
            if link.name != panel.link.name
        ]
    )


def _main_axis(vector: FloatArray) -> FloatArray:
    """Unit vector of the coordinate axis along which a vector is longest."""
    found = np.zeros(3)
    number = int(np.abs(vector).argmax())
    found[number] = math.copysign(1.0, vector[number])
    return found
