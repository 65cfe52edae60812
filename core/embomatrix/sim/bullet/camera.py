"""Oblique pictures of a scene by Bullet's software renderer, in a client of their own: the simulation carries no visuals."""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from scipy.spatial import ConvexHull

from embomatrix.sim.bullet.client import pybullet
from embomatrix.sim.engine import EngineError
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose, Shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Part
    from embomatrix.world.scene import Room, Scene

    FloatArray = NDArray[np.float64]
    Rgba = tuple[float, float, float, float]

CUT_M: Final = 0.45
"""Walls between the camera and the rooms are shown up to this height."""
CEILING_M: Final = 2.3
"""What hangs this high is left out: it would hide the rooms."""
ELEVATION: Final = math.radians(52.0)
AZIMUTH: Final = math.radians(-60.0)
"""The camera looks from the south-south-east."""
FIELD_OF_VIEW: Final = 35.0

_WALL: Final[Rgba] = (0.86, 0.86, 0.84, 1.0)
_FLOORS: Final[tuple[Rgba, ...]] = (
    (0.80, 0.70, 0.56, 1.0),
    (0.70, 0.76, 0.80, 1.0),
    (0.78, 0.74, 0.66, 1.0),
    (0.72, 0.78, 0.70, 1.0),
    (0.80, 0.72, 0.72, 1.0),
)
_OPENS: Final[Rgba] = (0.80, 0.58, 0.34, 1.0)
_WORKS: Final[Rgba] = (0.45, 0.60, 0.74, 1.0)
_RESTS: Final[Rgba] = (0.60, 0.47, 0.38, 1.0)
_SOFT: Final[Rgba] = (0.45, 0.50, 0.62, 1.0)
_ROBOT: Final[Rgba] = (0.85, 0.15, 0.15, 1.0)
_DOOR: Final[Rgba] = (0.55, 0.30, 0.18, 1.0)
_CLOTH: Final = frozenset({"bed", "sofa", "armchair", "ottoman", "carpet", "booth", "bench", "pillow"})
_ORIGIN: Final = Pose((0.0, 0.0, 0.0))


def render_oblique(scene: Scene, *, width_px: int = 1280, height_px: int = 960) -> NDArray[np.uint8]:
    """The whole scene from above and aside, near walls cut low, without a ceiling.

    Returns RGB values, shape (height, width, 3). Raises EngineError where pybullet is missing.
    """
    bullet = pybullet()
    client = int(bullet.connect(bullet.DIRECT))
    if client < 0:
        raise EngineError("Bullet opened no physics client: close engines that are not in use")
    try:
        stage = _Stage(bullet, client)
        stage.build(scene)
        return stage.shoot(scene, width_px, height_px)
    finally:
        bullet.disconnect(physicsClientId=client)


class _Stage:
    """Visual bodies of one scene in one client; shapes are made once and shared."""

    def __init__(self, bullet: Any, client: int) -> None:
        self._bullet = bullet
        self._client = client
        self._shapes: dict[tuple[object, ...], int] = {}

    def build(self, scene: Scene) -> None:
        for number, room in enumerate(scene.rooms):
            self._floor(room, _FLOORS[number % len(_FLOORS)])
        for wall in scene.walls:
            self._wall(scene, wall)
        for item in scene.objects:
            asset = scene.assets[item.asset_id]
            if (
                item.pose_world_asset.position_m[2] + asset.size_m[2] / 2 > CEILING_M
                and asset.size_m[2] < 1.8
            ):
                continue
            color = _color_of(asset)
            for number, link in enumerate(asset.links):
                # Leaves and drawers stand out from the body that they close.
                shade = color if number == 0 else _lighter(color)
                for part in link.parts:
                    self._part(part, item.pose_world_asset, shade)
        start = scene.robot
        body = Pose((start.x_m, start.y_m, 0.35))
        self._solid(Shape.CYLINDER, (2 * ROBOT.radius_m, 2 * ROBOT.radius_m, 0.7), body, _ROBOT)

    def shoot(self, scene: Scene, width_px: int, height_px: int) -> NDArray[np.uint8]:
        low = np.min([room.low_m for room in scene.rooms], axis=0)
        high = np.max([room.high_m for room in scene.rooms], axis=0)
        aspect = width_px / height_px
        target, distance = _framing(low, high, aspect)
        eye = target + _direction() * distance
        bullet = self._bullet
        view = bullet.computeViewMatrix(eye.tolist(), target.tolist(), [0.0, 0.0, 1.0])
        lens = bullet.computeProjectionMatrixFOV(FIELD_OF_VIEW, aspect, 0.5 * distance, 2.0 * distance)
        image = bullet.getCameraImage(
            width_px,
            height_px,
            view,
            lens,
            shadow=0,
            lightDirection=(0.5, -0.8, 2.0),
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        pixels = np.asarray(image[2], dtype=np.uint8).reshape(height_px, width_px, 4)
        return np.ascontiguousarray(pixels[..., :3])

    def _floor(self, room: Room, color: Rgba) -> None:
        size = (room.size_m[0] + 0.12, room.size_m[1] + 0.12, 0.04)
        self._solid(Shape.BOX, size, Pose((*room.center_m, -0.02)), color)

    def _wall(self, scene: Scene, wall: Part) -> None:
        """Walls with a room behind them, seen from the camera, are cut low; the others stand in full."""
        box = wall.aabb(_ORIGIN)
        leaf = min(wall.size_m[:2]) < 0.1
        if not self._hides(scene, wall):
            self._part(wall, _ORIGIN, _DOOR if leaf else _WALL)
        elif box.low_m[2] < CUT_M:
            x, y, _ = wall.pose.position_m
            size = (wall.size_m[0], wall.size_m[1], CUT_M)
            self._solid(Shape.BOX, size, Pose((x, y, CUT_M / 2)), _DOOR if leaf else _WALL)

    @staticmethod
    def _hides(scene: Scene, wall: Part) -> bool:
        """Whether a room lies right behind any stretch of the wall."""
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

    def _part(self, part: Part, pose_world_asset: Pose, color: Rgba) -> None:
        self._solid(part.shape, part.size_m, pose_world_asset @ part.pose, color, part.vertices_m)

    def _solid(
        self,
        shape: Shape,
        size: tuple[float, float, float],
        pose: Pose,
        color: Rgba,
        vertices: tuple[tuple[float, float, float], ...] = (),
    ) -> None:
        key = (shape, size, vertices, color)
        if key not in self._shapes:
            self._shapes[key] = self._visual(shape, size, color, vertices)
        self._bullet.createMultiBody(
            0.0,
            -1,
            self._shapes[key],
            basePosition=pose.position_m,
            baseOrientation=pose.quat_xyzw,
            physicsClientId=self._client,
        )

    def _visual(
        self,
        shape: Shape,
        size: tuple[float, float, float],
        color: Rgba,
        vertices: tuple[tuple[float, float, float], ...],
    ) -> int:
        bullet = self._bullet
        look: dict[str, Any] = {
            "rgbaColor": color,
            "specularColor": (0, 0, 0),
            "physicsClientId": self._client,
        }
        match shape:
            case Shape.BOX:
                half = tuple(max(extent, 0.002) / 2 for extent in size)
                return int(bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=half, **look))
            case Shape.CYLINDER:
                return int(
                    bullet.createVisualShape(bullet.GEOM_CYLINDER, radius=size[0] / 2, length=size[2], **look)
                )
            case Shape.SPHERE:
                return int(bullet.createVisualShape(bullet.GEOM_SPHERE, radius=size[0] / 2, **look))
            case Shape.HULL:
                mesh = _faces(np.asarray(vertices))
                return int(bullet.createVisualShape(bullet.GEOM_MESH, **mesh, **look))


def _faces(points: FloatArray) -> dict[str, list[Any]]:
    """Outward triangles of a convex hull, each with its own three vertices and its normal."""
    hull = ConvexHull(points)
    triangles = points[hull.simplices]  # (f, 3, 3)
    normals = hull.equations[:, :3]
    inward = (
        np.einsum(
            "fi,fi->f",
            np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]),
            normals,
        )
        < 0
    )
    triangles[inward] = triangles[inward][:, ::-1]
    count = len(triangles) * 3
    return {
        "vertices": triangles.reshape(-1, 3).tolist(),
        "indices": list(range(count)),
        "normals": np.repeat(normals, 3, axis=0).tolist(),
    }


def _direction() -> FloatArray:
    """Unit vector from the scene to the camera."""
    flat = math.cos(ELEVATION)
    return np.array([flat * math.cos(AZIMUTH), flat * math.sin(AZIMUTH), math.sin(ELEVATION)])


def _framing(low: FloatArray, high: FloatArray, aspect: float) -> tuple[FloatArray, float]:
    """The point to look at and the distance from it at which all corners of the rooms just fit into the picture."""
    look = _direction()
    right = np.cross([0.0, 0.0, 1.0], look)
    right /= np.linalg.norm(right)
    up = np.cross(look, right)
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, 2.4)])
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2))
    target = corners.mean(axis=0)
    distance = 1.0
    # A few rounds: moving the target changes the perspective, and that the extent.
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


def _color_of(asset: Asset) -> Rgba:
    """Colour by what the object is for; small things get a lively one that their category decides."""
    if max(asset.size_m) < 0.6 and asset.mass_kg <= ROBOT.mass_kg:
        return _hue(zlib.crc32(asset.category.encode()) / 2**32)
    if asset.category in _CLOTH:
        return _SOFT
    if asset.can("openable"):
        return _OPENS
    return _WORKS if asset.can("toggleable") or asset.can("heatSource") else _RESTS


def _hue(share: float) -> Rgba:
    red, green, blue = (0.5 + 0.4 * math.cos(2 * math.pi * (share + shift)) for shift in (0.0, 1 / 3, 2 / 3))
    return (red, green, blue, 1.0)


def _lighter(color: Rgba) -> Rgba:
    red, green, blue = (channel + 0.3 * (1.0 - channel) for channel in color[:3])
    return (red, green, blue, 1.0)
