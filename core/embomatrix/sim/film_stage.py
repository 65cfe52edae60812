"""Stages of a film: visual scenes that show one frame after another."""

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.bullet.camera import furnish_cutaway, shoot_oblique
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.film import FilmFrame
from embomatrix.world.scene import Scene


class FilmStage:
    """Visual scene of a film. Its objects stand as in the frame that was shown last."""

    def __init__(self, stage: VisualScene) -> None:
        self.stage = stage
        self._changed: frozenset[str] = frozenset()

    def show(self, frame: FilmFrame) -> None:
        """Move the objects of the frame to their places, and those of the former frame back to the scene's start."""
        changed = frozenset({*frame.poses, *frame.joints, *frame.hidden})
        for name in sorted(changed | self._changed):
            self._show(frame, name)
        self._changed = changed

    def _show(self, frame: FilmFrame, name: str) -> None:
        item = self.stage.scene.by_name[name]
        if name in frame.hidden or (item.absent and name not in frame.poses):
            self.stage.hide(name)
        else:
            pose = frame.poses.get(name, item.pose_world_asset)
            self.stage.put(name, pose, frame.joints.get(name, item.joints))


class RoomCamera:
    """Camera that sees the robot and its room obliquely from above, as in films."""

    def __init__(self, scene: Scene) -> None:
        """Load the scene into a renderer. Raises EngineError if pybullet is missing."""
        self.scene = scene
        self._view = FilmStage(VisualScene(scene))
        furnish_cutaway(self._view.stage)
        self._robot = self._view.stage.add_robot()

    def shoot(self, frame: FilmFrame, width_px: int, height_px: int) -> NDArray[np.uint8]:
        """Render a frame: RGB values, shape (height, width, 3). All rooms are in view if the robot is in none."""
        self._view.show(frame)
        self._robot.stand(frame.posture or tucked(frame.robot))
        name = self.scene.room_at((frame.robot.x_m, frame.robot.y_m))
        rooms = tuple(room for room in self.scene.rooms if room.name == name) or self.scene.rooms
        return shoot_oblique(self._view.stage, rooms, width_px, height_px)

    def close(self) -> None:
        """Free the renderer."""
        self._view.stage.__exit__()
