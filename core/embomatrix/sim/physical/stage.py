"""Stage of a physical rollout: the planning scene, in which relations are read, and the dynamic world, which decides.

Motions are planned in the first and made in the second. Objects that moved are copied back after every skill.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.joints.panels import swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.physical import arm
from embomatrix.sim.physical.floor import Floor
from embomatrix.sim.physical.motion import Mover
from embomatrix.sim.physical.reach import ArmReach, HeldGeometry, limb_balls
from embomatrix.sim.physical.space import Boxes, boxes_around, object_balls
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld

SETTLE_STEPS: Final = 240
"""Longest settling time, in steps of 1/240 s. The world then counts as settled."""
AROUND_M: Final = 1.9
"""Objects farther than this from the base are out of the arm's reach."""
SLIP_M: Final = 0.04
WAKE_M: Final = 0.03
TOOL: Final = Pose((0.0, 0.0, arm.TOOL_M))
"""Frame of the tool in the frame of the hand."""
NEARER: Final = 24
SPAN_M: Final = 0.5
APART: Final = 0.13
"""Standing places to try if the arm does not reach from the present one: number, distance range, spacing."""


@dataclass(frozen=True, slots=True)
class Grip:
    """Held object, its pose in the tool's frame, and its balls there."""

    name: str
    pose_tool_object: Pose
    held: HeldGeometry

    def held_as(self, pose_tool_object: Pose) -> Grip:
        """Return the grip on the same object at another pose in the tool's frame."""
        change = pose_tool_object @ self.pose_tool_object.inverse()
        up = None if self.held.up is None else change.rotation @ self.held.up
        held = HeldGeometry(change.apply_all(self.held.centres), self.held.radii, up)
        return Grip(self.name, pose_tool_object, held)


class PhysicalStage:
    """Planning scene, dynamic world and robot of one rollout. ``begin`` starts the next rollout."""

    def __init__(self, world: LiveWorld, dynamic: DynamicWorld, watch: Callable[[], None]) -> None:
        self.world = world
        self.dynamic = dynamic
        self.mover = Mover(dynamic, watch)
        self.floor = Floor(world.navigator)
        self.grip: Grip | None = None
        self.commanded = world.robot
        """Commanded standing pose. The robot leaves it to work and returns; with a load it may face elsewhere."""

    def begin(self) -> None:
        """Build the dynamic world in the state of the planning scene."""
        engine, robot = self.world.engine, self.world.robot
        names = [item.name for item in self.world.scene.objects]
        poses = {name: engine.pose(name) for name in names if not engine.is_parked(name)}
        joints = {name: engine.joints(name) for name in names}
        self.dynamic.build(poses, joints, tucked(robot))
        self.grip, self.commanded = None, robot

    def stand_at(self, stand: StandPose) -> None:
        """Put the robot at a pose with its arm tucked, in both worlds, without a route."""
        self.world.robot = self.commanded = stand
        self.dynamic.robot.appear(tucked(stand))

    def open_around(self, name: str) -> None:
        """Open the closed containers around an object in the planning scene, as far as there is room."""
        world = self.world
        for enclosure in world.relations.enclosing(name):
            if enclosure.closed:
                swing_panels(world.engine, world.relations, enclosure.name, SWING)

    def boxes(self) -> Boxes:
        """Return the parts of objects around the robot, without the load."""
        x, y, _ = self.mover.posture[:3]
        return boxes_around(self.world.engine, (x - AROUND_M, y - AROUND_M), (x + AROUND_M, y + AROUND_M))

    def boxes_within(self, low: FloatArray, high: FloatArray) -> Boxes:
        """Return the parts of objects between two corners, each of shape (3,), without the load."""
        window = ((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        return boxes_around(self.world.engine, *window).near(low, high)

    def reach(
        self, boxes: Boxes, target: str = "", also: Callable[[FloatArray], bool] | None = None
    ) -> ArmReach:
        """Return the reach of the hand among boxes. It may touch the target. ``also``: additional test of paths."""
        held = self.grip.held if self.grip is not None else None
        return ArmReach(boxes, boxes.without((target,)) if target else boxes, held, also)

    def bases(
        self,
        point: FloatArray,
        away_m: float = 0.6,
        course: float | None = None,
        walk_m: float = ROBOT.reach_m,
    ) -> list[FloatArray]:
        """Return standing places for work at a point: here, shape (1, 3), then others, (b, 3), the likeliest first.

        ``away_m``: suitable distance; ``course``: required heading of the hand; ``walk_m``: longest drive. The spacing of the
        places grows with ``walk_m``.
        """
        here = self.mover.posture[:3]
        yaw = math.atan2(point[1] - here[1], point[0] - here[0])
        wide = away_m + SPAN_M
        low, high = (point[0] - wide, point[1] - wide), (point[0] + wide, point[1] + wide)
        grid = self.floor.grid
        cell = grid.cell(float(here[0]), float(here[1]))
        spots = grid.free_centers(low, high, grid.label(cell) if cell is not None else 0)
        options = [np.array([[here[0], here[1], yaw]])]
        if len(spots):
            away = np.linalg.norm(spots - point[:2], axis=1)
            walk = np.linalg.norm(spots - here[:2], axis=1)
            cost = np.abs(away - away_m) + 0.3 * walk
            if course is not None:
                ahead = (point[:2] - spots) @ np.array([math.cos(course), math.sin(course)])
                cost += 1.0 - ahead / np.maximum(away, 1e-6)
            chosen: list[tuple[float, float, float]] = []
            for number in np.argsort(cost, kind="stable").tolist():
                x, y = spots[number].tolist()
                if walk[number] > walk_m or away[number] < 0.35:
                    continue
                if all(math.hypot(x - other[0], y - other[1]) > APART * walk_m for other in chosen):
                    chosen.append((x, y, math.atan2(point[1] - y, point[0] - x)))
                if len(chosen) == NEARER:
                    break
            half = len(chosen) // 2
            options += [np.array(part) for part in (chosen[:half], chosen[half:]) if part]
        return options

    def limbs(self, postures: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the balls of the arm and of its load: centres (n, k, 3) and radii (k,)."""
        return limb_balls(postures, self.grip.held if self.grip is not None else None)

    def take(self, name: str) -> None:
        """Grip the touched object."""
        self.grip = self.grip_with(
            self.dynamic.robot.hand_pose() @ TOOL, self.dynamic.bodies.pose(name), name
        )
        self.dynamic.grasp(name)

    def grip_with(self, pose_tool: Pose, pose_object: Pose, name: str) -> Grip:
        """Return the grip on an object with tool and object at these poses in the world."""
        local = pose_tool.inverse() @ pose_object
        centres, radii = self._balls(name, local)
        up = local.rotation @ pose_object.rotation[2] if len(self.world.cargo(name)) > 1 else None
        return Grip(name, local, HeldGeometry(centres, radii, up))

    def _balls(self, name: str, pose_tool_object: Pose) -> tuple[FloatArray, FloatArray]:
        """Return the balls of an object and of its contents in the tool's frame."""
        engine = self.world.engine
        centres, radii = [], []
        base = engine.pose(name)
        for item in self.world.cargo(name):
            points, sizes = object_balls(self.world.asset(item), engine.joints(item))
            frame = pose_tool_object @ (base.inverse() @ engine.pose(item))
            centres.append(frame.apply_all(points))
            radii.append(sizes)
        return np.concatenate(centres), np.concatenate(radii)

    def release(self) -> None:
        """Let go of the held object."""
        held = self.grip.name if self.grip is not None else ""
        self.loosen()
        if held:
            self.dynamic.part_from(held)

    def loosen(self) -> None:
        """Let go without dragging the object along until hand and object part in the dynamic world."""
        self.dynamic.loosen()
        self.grip = None

    def leave(self) -> None:
        """Add the object that left the hand, and its contents, to the planning scene where they are now."""
        group = self.world.carried
        self.world.hand.forget()
        for name in group:
            self.world.engine.set_pose(name, self.dynamic.bodies.pose(name))
        self.world.navigator.refresh()

    def drop(self) -> None:
        """Let go of an object that slipped: the hand is empty, and what fell can be picked up where it came to rest."""
        self.release()
        self.dynamic.settle(SETTLE_STEPS)
        self.leave()

    def has_slipped(self) -> bool:
        """True if the held object has moved in the hand."""
        if self.grip is None:
            return False
        tool = self.dynamic.robot.hand_pose() @ TOOL
        wanted = tool @ self.grip.pose_tool_object
        return math.dist(wanted.position_m, self.dynamic.bodies.pose(self.grip.name).position_m) > SLIP_M

    def wake_around(self, box: Aabb) -> None:
        """Wake objects at or on a box that is about to move."""
        self.wake(self.world.engine.near(box.grown(WAKE_M)))

    def wake(self, names: Iterable[str]) -> None:
        """Wake movable objects."""
        self.dynamic.bodies.wake(name for name in names if not self.world.is_fixed(name))

    def bring_in_step(self) -> None:
        """Remove objects from the dynamic world that left the planning scene, and add new ones: effects of cutting."""
        engine = self.world.engine
        for item in self.world.scene.objects:
            if item.fixed or item.name in self.world.carried:
                continue
            if engine.is_parked(item.name) and self.dynamic.bodies.is_in(item.name):
                self.dynamic.bodies.take_out(item.name)
            elif not engine.is_parked(item.name) and not self.dynamic.bodies.is_in(item.name):
                self.dynamic.bodies.put(item.name, engine.pose(item.name))

    def settle(self) -> None:
        """Let the world come to rest and copy moved objects into the planning scene."""
        self.dynamic.settle(SETTLE_STEPS)
        self.copy()

    def copy(self) -> None:
        """Copy the robot's pose and moved objects, except the held one, into the planning scene."""
        world, engine = self.world, self.world.engine
        x, y, yaw = self.mover.posture[:3].tolist()
        world.robot = StandPose(x, y, math.remainder(yaw, math.tau))
        moved = False
        for name in self.dynamic.disturbed():
            if engine.is_parked(name):
                continue
            if world.is_fixed(name):
                engine.set_joints(name, self.dynamic.bodies.joints(name))
            else:
                engine.set_pose(name, self.dynamic.bodies.pose(name))
            moved = True
        if moved:
            world.navigator.refresh()


def compact(stage: PhysicalStage, posture: FloatArray) -> bool:
    """True if arm and load stay over the base's disc."""
    points, radii = stage.limbs(posture[None])
    return bool((np.linalg.norm(points[0, :, :2] - posture[:2], axis=1) + radii).max() <= ROBOT.radius_m)
