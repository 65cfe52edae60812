"""Where a physical rollout takes place: the planning scene, in which meaning is read, and the dynamic world, which decides.

Motions are planned in the one and made in the other; after every skill what moved there is copied back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.joints.panels import swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.floor import Floor
from embomatrix.sim.physical.motion import Mover
from embomatrix.sim.physical.reach import ArmReach, HeldGeometry
from embomatrix.sim.physical.space import boxes_around, object_balls
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from embomatrix.sim.bullet.dynamic import DynamicWorld
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.physical.space import Boxes
    from embomatrix.world.geometry import FloatArray

SETTLE_STEPS: Final = 240
"""After a second the world is taken as it is, at rest or not."""
AROUND_M: Final = 1.9
"""Things farther than this from the base are out of the arm's way."""
SLIP_M: Final = 0.04
WAKE_M: Final = 0.03
TOOL: Final = Pose((0.0, 0.0, arm.TOOL_M))
"""The tool's frame in the hand's."""
NEARER: Final = 24
SPAN_M: Final = 0.5
APART: Final = 0.13
"""Places that are tried when the arm does not reach from where the robot stands."""


@dataclass(frozen=True, slots=True)
class Grip:
    """What the hand holds and how: the object's pose in the tool's frame, and its balls there."""

    name: str
    pose_tool_object: Pose
    held: HeldGeometry

    def otherwise(self, pose_tool_object: Pose) -> Grip:
        """What it would be to hold the same in another way."""
        change = pose_tool_object @ self.pose_tool_object.inverse()
        up = None if self.held.up is None else change.rotation @ self.held.up
        held = HeldGeometry(change.apply_all(self.held.centres), self.held.radii, up)
        return Grip(self.name, pose_tool_object, held)


class PhysicalStage:
    """One rollout's two worlds and the robot. ``begin`` starts the next."""

    def __init__(self, world: LiveWorld, dynamic: DynamicWorld, watch: Callable[[], None]) -> None:
        self.world = world
        self.dynamic = dynamic
        self.mover = Mover(dynamic, watch)
        self.floor = Floor(world.navigator)
        self.grip: Grip | None = None
        self.told = world.robot
        """Where the robot was told to stand, which it leaves to work and comes back to: with a load it may face elsewhere."""

    def begin(self) -> None:
        """Build the dynamic world as the planning scene is."""
        engine, robot = self.world.engine, self.world.robot
        names = [item.name for item in self.world.scene.objects]
        poses = {name: engine.pose(name) for name in names if not engine.is_parked(name)}
        joints = {name: engine.joints(name) for name in names}
        self.dynamic.build(poses, joints, tucked(robot))
        self.grip, self.told = None, robot

    def stand_at(self, stand: StandPose) -> None:
        """Put the robot somewhere with its arm tucked, in both worlds. Nothing is asked about the way there."""
        self.world.robot = self.told = stand
        self.dynamic.robot.appear(tucked(stand))

    def open_around(self, name: str) -> None:
        """Open in the planning scene whatever is shut around an object, as far as there is room."""
        world = self.world
        for enclosure in world.relations.enclosing(name):
            if enclosure.closed:
                swing_panels(world.engine, world.relations, enclosure.name, SWING)

    def boxes(self) -> Boxes:
        """Parts of things around the robot, without what it holds."""
        x, y, _ = self.mover.posture[:3]
        return boxes_around(self.world.engine, (x - AROUND_M, y - AROUND_M), (x + AROUND_M, y + AROUND_M))

    def boxes_within(self, low: FloatArray, high: FloatArray) -> Boxes:
        """Parts of things between two corners, each of shape (3,), without what the hand holds."""
        window = ((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        return boxes_around(self.world.engine, *window).near(low, high)

    def reach(
        self, boxes: Boxes, target: str = "", also: Callable[[FloatArray], bool] | None = None
    ) -> ArmReach:
        """Ways of the hand as it is, among boxes; it may touch the target. ``also`` has a say in which of them are free."""
        held = self.grip.held if self.grip is not None else None
        return ArmReach(boxes, boxes.without((target,)) if target else boxes, held, also)

    def bases(
        self,
        point: FloatArray,
        away_m: float = 0.6,
        course: float | None = None,
        walk_m: float = ROBOT.reach_m,
    ) -> list[FloatArray]:
        """Where the base may stand to work at a point: here, shape (1, 3); then other places, (b, 3), the likeliest first.

        ``away_m`` is the distance that suits the work, ``course`` the heading in which the hand must go, ``walk_m`` how far the
        base may go. Places are the farther apart the farther it may.
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

    def take(self, name: str) -> None:
        """The hand holds what it touches."""
        self.grip = self.grip_with(
            self.dynamic.robot.hand_pose() @ TOOL, self.dynamic.bodies.pose(name), name
        )
        self.dynamic.grasp(name)

    def grip_with(self, pose_tool: Pose, pose_object: Pose, name: str) -> Grip:
        """What it is to hold an object with the tool and the object at these poses in the world."""
        local = pose_tool.inverse() @ pose_object
        centres, radii = self._balls(name, local)
        up = local.rotation @ pose_object.rotation[2] if len(self.world.cargo(name)) > 1 else None
        return Grip(name, local, HeldGeometry(centres, radii, up))

    def _balls(self, name: str, pose_tool_object: Pose) -> tuple[FloatArray, FloatArray]:
        """Balls of an object and of all that lies in it, in the tool's frame."""
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
        """The hand lets go."""
        held = self.grip.name if self.grip is not None else ""
        self.loosen()
        if held:
            self.dynamic.part_from(held)

    def loosen(self) -> None:
        """The hand lets go, and leaves what it held without dragging it along until they part in the dynamic world."""
        self.dynamic.loosen()
        self.grip = None

    def has_slipped(self) -> bool:
        """Whether what the hand should hold is not where the hand holds it."""
        if self.grip is None:
            return False
        tool = self.dynamic.robot.hand_pose() @ TOOL
        wanted = tool @ self.grip.pose_tool_object
        return math.dist(wanted.position_m, self.dynamic.bodies.pose(self.grip.name).position_m) > SLIP_M

    def wake_around(self, box: Aabb) -> None:
        """Wake what lies at or on something between two corners that is about to move."""
        self.wake(self.world.engine.near(box.grown(WAKE_M)))

    def wake(self, names: Iterable[str]) -> None:
        """Wake movable objects."""
        self.dynamic.bodies.wake(name for name in names if not self.world.is_fixed(name))

    def bring_in_step(self) -> None:
        """Take out of the dynamic world what left the planning scene, and bring in what came: things that were cut."""
        engine = self.world.engine
        for item in self.world.scene.objects:
            if item.fixed or item.name in self.world.carried:
                continue
            if engine.is_parked(item.name) and self.dynamic.bodies.is_in(item.name):
                self.dynamic.bodies.take_out(item.name)
            elif not engine.is_parked(item.name) and not self.dynamic.bodies.is_in(item.name):
                self.dynamic.bodies.put(item.name, engine.pose(item.name))

    def settle(self) -> None:
        """Let the world come to rest and copy what moved into the planning scene."""
        self.dynamic.settle(SETTLE_STEPS)
        self.copy()

    def copy(self) -> None:
        """Take over where the robot is and what moved, but what the hand holds."""
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
    """Whether arm and load stay over the base's disc."""
    row = posture[None]
    points, radii = body.balls(row)[0], body.RADII
    if stage.grip is not None:
        points = np.concatenate([points, stage.grip.held.placed(row)[0]])
        radii = np.concatenate([radii, stage.grip.held.radii])
    return bool((np.linalg.norm(points[:, :2] - posture[:2], axis=1) + radii).max() <= ROBOT.radius_m)
