"""Films of the physical mode: the robot and all moved objects, as recorded in the dynamic world."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.film import FRAMES_PER_S, Film, FilmFrame
from embomatrix.skills.syntax import Plan
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.physical.actor import PhysicalActor

PACE: Final = 2
"""Playback speed relative to simulated time."""
STEPS_PER_FRAME: Final = PACE * 240 // FRAMES_PER_S
"""Steps of 1/240 s between two frames."""
MOTION_THRESHOLD: Final = 3e-3
"""Motion below this, in metres or in a quaternion component, is not shown."""


def film_physical(simulator: Simulator, actor: PhysicalActor, task: Task, plan: Plan, seed: int) -> Film:
    """Execute a plan physically up to its end or its first failed step, and record it. ``actor`` is the simulator's."""
    simulator.reset(task, seed)
    camera = _Camera(simulator.world.scene, actor)
    camera.shoot()
    steps = []
    actor.watch(camera.tick)
    try:
        for number, call in enumerate(plan, start=1):
            camera.step = number
            steps.append(simulator.run_step(call))
            camera.shoot()
            if not steps[-1].ok:
                break
    finally:
        actor.watch(None)
    return Film(simulator.world.scene, task, plan, tuple(steps), tuple(camera.frames))


class _Camera:
    """Recorder that takes a frame whenever enough simulated time has passed."""

    def __init__(self, scene: Scene, actor: PhysicalActor) -> None:
        self._scene = scene
        self._dynamic = actor.dynamic
        self._next = 0
        self.frames: list[FilmFrame] = []
        self.step = 0

    def tick(self) -> None:
        """Take a frame if it is due."""
        if self._dynamic.steps >= self._next:
            self.shoot()

    def shoot(self) -> None:
        """Take a frame now."""
        self._next = self._dynamic.steps + STEPS_PER_FRAME
        poses: dict[str, Pose] = {}
        joints: dict[str, tuple[float, ...]] = {}
        hidden: set[str] = set()
        for item in self._scene.objects:
            if item.fixed and not item.joints:
                continue
            if not self._dynamic.bodies.is_in(item.name):
                hidden.add(item.name)
                continue
            pose = self._dynamic.bodies.pose(item.name)
            if item.absent or _moved(pose, item.pose_world_asset):
                poses[item.name] = pose
            # Lids of small boxes don't move in the dynamic world.
            if item.fixed and item.joints:
                joints[item.name] = self._dynamic.bodies.joints(item.name)
        posture = self._dynamic.robot.posture
        base = StandPose(posture.x_m, posture.y_m, posture.yaw)
        self.frames.append(FilmFrame(base, self.step, poses, joints, frozenset(hidden), posture))


def _moved(now: Pose, before: Pose) -> bool:
    changes = zip((*now.position_m, *now.quat_xyzw), (*before.position_m, *before.quat_xyzw), strict=True)
    return any(abs(a - b) > MOTION_THRESHOLD for a, b in changes)
