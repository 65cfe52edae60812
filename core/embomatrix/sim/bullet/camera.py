"""Pictures of a scene, oblique from above and from the robot's camera: fine ones, and fast ones in flat colours for films."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.bullet.photograph import Photo, Photographer
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.looks.view import View
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.scene import Room, Scene, SceneObject

FloatArray = NDArray[np.float64]

CUT_M: Final = 0.45
"""Walls between the camera and the rooms are shown up to this height."""
CEILING_M: Final = 2.3
"""Objects that hang this high are left out: they would hide the rooms."""
FLAT_M: Final = 0.15
"""Things on walls that stand out less are flat: pictures, mirrors, clocks, switches."""
WALL_GAP_M: Final = 0.1
"""Largest distance from a wall to what hangs on it."""
_SHOWN_M: Final = 3.6
"""Walls of higher rooms are shown up to this height in oblique pictures."""
ELEVATION: Final = math.radians(52.0)
AZIMUTH: Final = math.radians(-60.0)
"""The camera looks from the south-south-east."""
FIELD_OF_VIEW: Final = 35.0
EYE_M: Final = 1.35
"""Height of the robot's camera over the floor, above the middle of its base."""
EYE_PITCH: Final = math.radians(-22.0)
EYE_FIELD_OF_VIEW: Final = 75.0
"""The robot's camera looks slightly down, to see the tops of nearby tables."""
EYE_NEAR_M: Final = 0.05
EYE_FAR_M: Final = 30.0
NEAR_M: Final = 5.0
"""Pictures of the robot's camera show shadows up to this distance on both axes."""


def render_oblique(scene: Scene, *, width_px: int = 1280, height_px: int = 960) -> NDArray[np.uint8]:
    """Render the whole scene obliquely from above, with low near walls and without ceiling objects.

    Returns RGB values, shape (height, width, 3). Raises EngineError if pybullet is missing.
    """
    return photograph_oblique(scene, width_px=width_px, height_px=height_px).pixels


def render_egocentric(
    scene: Scene, stand: StandPose | None = None, *, width_px: int = 320, height_px: int = 240
) -> NDArray[np.uint8]:
    """Render four views of the robot at ``stand``, or at its start: ahead, left, behind, right.

    Returns RGB values, shape (4, height, width, 3). Raises EngineError if pybullet is missing.
    """
    photos = photograph_around(scene, stand, width_px=width_px, height_px=height_px)
    return np.stack([photo.pixels for photo in photos])


def photograph_oblique(scene: Scene, *, width_px: int = 1280, height_px: int = 960) -> Photo:
    """Render the whole scene as `render_oblique` does, with the objects that the picture shows."""
    with VisualScene(scene) as stage:
        furnish_cutaway(stage)
        stage.add_robot().stand(tucked(start_of(scene)))
        view = oblique_view(scene.rooms, width_px / height_px)
        return Photographer(stage).shoot(view, box_of(scene.rooms), width_px, height_px)


def photograph_around(
    scene: Scene, stand: StandPose | None = None, *, width_px: int = 320, height_px: int = 240
) -> tuple[Photo, ...]:
    """Render four views as `render_egocentric` does, with the objects that each shows."""
    start = stand or start_of(scene)
    with VisualScene(scene) as stage:
        furnish_whole(stage)
        photographer, region = Photographer(stage), surroundings(scene, start)
        quarters = (replace(start, yaw=start.yaw + turns * math.pi / 2) for turns in range(4))
        views = [eye_view(quarter, width_px / height_px) for quarter in quarters]
        return tuple(photographer.shoot(view, region, width_px, height_px, outdoors=True) for view in views)


def furnish_cutaway(stage: VisualScene) -> None:
    """Fill a stage for oblique pictures: no ceiling objects, near walls cut low and without the pictures on them."""
    scene = stage.scene
    low_walls = [wall.aabb(IDENTITY) for wall in scene.walls if _hides(scene, wall)]

    def is_shown(item: SceneObject) -> bool:
        hangs_on_wall = item.fixed and not item.host
        floats = hangs_on_wall and _would_float(scene.box_of(item.name), low_walls)
        return not (floats or _hangs_at_ceiling(scene, item))

    stage.add_floors()
    stage.add_walls(lambda wall: _cut(scene, wall))
    stage.add_objects(is_shown)
    stage.add_background(lambda item, box: bool(item.host) or not _would_float(box, low_walls))


def furnish_whole(stage: VisualScene) -> None:
    """Fill a stage for inside pictures: full walls, ceilings and what hangs there."""
    stage.add_floors()
    stage.add_ceilings()
    stage.add_walls(lambda wall: wall)
    stage.add_objects()
    stage.add_background()


def shoot_oblique(
    stage: VisualScene, rooms: tuple[Room, ...], width_px: int, height_px: int
) -> NDArray[np.uint8]:
    """Render these rooms obliquely, filling the picture, in flat colours."""
    return stage.shoot(oblique_view(rooms, width_px / height_px), width_px, height_px)


def shoot_egocentric(
    stage: VisualScene, stand: StandPose, width_px: int, height_px: int
) -> NDArray[np.uint8]:
    """Render the view of the robot's camera at a standing pose, in flat colours."""
    return stage.shoot(eye_view(stand, width_px / height_px), width_px, height_px)


def oblique_view(rooms: tuple[Room, ...], aspect: float) -> View:
    """Return the view of a camera outside and above that sees all of these rooms."""
    box = box_of(rooms)
    target, distance = _framing(np.array(box.low_m), np.array(box.high_m), aspect)
    eye = (target + _direction() * distance).tolist()
    return View.toward(eye, target.tolist(), FIELD_OF_VIEW, aspect, 0.5 * distance, 2.0 * distance)


def eye_view(stand: StandPose, aspect: float) -> View:
    """Return the view of the robot's camera at a standing pose."""
    flat = math.cos(EYE_PITCH)
    eye = (stand.x_m, stand.y_m, EYE_M)
    ahead = (flat * math.cos(stand.yaw), flat * math.sin(stand.yaw), math.sin(EYE_PITCH))
    target = tuple(start + step for start, step in zip(eye, ahead, strict=True))
    return View.toward(eye, target, EYE_FIELD_OF_VIEW, aspect, EYE_NEAR_M, EYE_FAR_M)


def box_of(rooms: tuple[Room, ...]) -> Aabb:
    """Return the box of rooms up to the height that oblique pictures show."""
    low, high = (
        np.min([room.low_m for room in rooms], axis=0),
        np.max([room.high_m for room in rooms], axis=0),
    )
    height = max(min(room.height_m, _SHOWN_M) for room in rooms)
    return Aabb((float(low[0]), float(low[1]), 0.0), (float(high[0]), float(high[1]), height))


def surroundings(scene: Scene, stand: StandPose) -> Aabb:
    """Return the part of the scene near a standing pose: its shadows are drawn."""
    whole = box_of(scene.rooms)
    low = [max(bound, at - NEAR_M) for bound, at in zip(whole.low_m, (stand.x_m, stand.y_m), strict=False)]
    high = [min(bound, at + NEAR_M) for bound, at in zip(whole.high_m, (stand.x_m, stand.y_m), strict=False)]
    return Aabb((low[0], low[1], 0.0), (high[0], high[1], whole.high_m[2]))


def start_of(scene: Scene) -> StandPose:
    """Return the standing pose of the robot at the start."""
    return StandPose(scene.robot.x_m, scene.robot.y_m, scene.robot.yaw)


def _hangs_at_ceiling(scene: Scene, item: SceneObject) -> bool:
    height = scene.assets[item.asset_id].size_m[2]
    middle = item.pose_world_asset.position_m[2]
    return middle + height / 2 > CEILING_M and (height < 1.8 or middle > CEILING_M)


def _would_float(box: Aabb, low_walls: Sequence[Aabb]) -> bool:
    """Return True for the box of a flat thing that hangs on a wall cut below it, such as a picture."""
    return box.low_m[2] > CUT_M and any(
        wall.overlaps(box, WALL_GAP_M) and box.size_m[int(np.argmin(wall.size_m[:2]))] < FLAT_M
        for wall in low_walls
    )


def _cut(scene: Scene, wall: ConvexPart) -> ConvexPart | None:
    """Cut walls that hide a room from the camera low, the others at the height that is shown."""
    upper_m = CUT_M if _hides(scene, wall) else _SHOWN_M
    low_m = wall.aabb(IDENTITY).low_m[2]
    if low_m >= upper_m:
        return None
    x, y, _ = wall.pose.position_m
    high_m = min(upper_m, wall.aabb(IDENTITY).high_m[2])
    size = (wall.size_m[0], wall.size_m[1], high_m - low_m)
    return replace(wall, size_m=size, pose=Pose((x, y, (low_m + high_m) / 2), wall.pose.quat_xyzw))


def _hides(scene: Scene, wall: ConvexPart) -> bool:
    """Return True if a room lies right behind any stretch of the wall."""
    look = _direction()
    length = max(wall.size_m[:2])
    along = np.array([1.0, 0.0]) if wall.size_m[0] > wall.size_m[1] else np.array([0.0, 1.0])
    behind = -np.sign(look[:2]) * (1 - along) * 0.3
    middle = np.asarray(wall.pose.position_m[:2])
    for share in np.linspace(-0.5, 0.5, max(2, int(length / 0.4))):
        x, y = middle + along * share * (length - 0.3) + behind
        if any(room.contains(float(x), float(y)) for room in scene.rooms):
            return True
    return False


def _direction() -> FloatArray:
    """Unit vector from the scene to the camera."""
    flat = math.cos(ELEVATION)
    return np.array([flat * math.cos(AZIMUTH), flat * math.sin(AZIMUTH), math.sin(ELEVATION)])


def _framing(low: FloatArray, high: FloatArray, aspect: float) -> tuple[FloatArray, float]:
    """Target and distance at which all corners of the rooms just fit into the picture."""
    look = _direction()
    right = np.cross([0.0, 0.0, 1.0], look)
    right /= np.linalg.norm(right)
    up = np.cross(look, right)
    corners = np.array([*itertools.product(*zip(low, high, strict=True))])  # (8, 3)
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2))
    target = corners.mean(axis=0)
    distance = 1.0
    # Iterates: moving the target changes the perspective and with it the extent.
    for _ in range(8):
        local = corners - target
        distance = float(
            np.max(np.maximum(np.abs(local @ right) / aspect, np.abs(local @ up)) / tangent + local @ look)
        )
        depth = distance - local @ look
        across, along = local @ right / depth, local @ up / depth
        middle = (right * (across.max() + across.min()) + up * (along.max() + along.min())) / 2
        target = target + middle * distance
    return target, distance * 1.04
