"""Visual bodies of a scene in a separate client, for pictures: the simulation has no visuals.

Every solid is a body without a collision shape. Shapes are shared; objects can be moved, opened and hidden between pictures.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from embomatrix.sim.bullet.client import BulletClient, connect
from embomatrix.sim.bullet.robot import Posture, load_robot, spread
from embomatrix.sim.bullet.robot_model import DRIVEN_JOINTS
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.sim.geometry.door_leaves import door_leaves
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, ConvexPart, Pose, Shape, Vec3
from embomatrix.world.scene import Scene, SceneObject

FloatArray = NDArray[np.float64]
Rgba = tuple[float, float, float, float]

OUT_OF_SIGHT: Final = Pose((0.0, 0.0, -100.0))

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
_DOOR: Final[Rgba] = (0.55, 0.30, 0.18, 1.0)
_GLASS: Final[Rgba] = (0.66, 0.84, 0.93, 1.0)
_MIRROR: Final[Rgba] = (0.90, 0.96, 0.99, 1.0)
_FRAME: Final[Rgba] = (0.30, 0.27, 0.25, 1.0)
_LEAVES: Final[Rgba] = (0.42, 0.58, 0.36, 1.0)
_PLANTS: Final = frozenset(
    {"tree", "low_resolution_tree", "bush", "pot_plant", "hanging_plant", "greenery", "vine"}
)
_MIRRORS: Final = frozenset({"mirror", "standing_mirror"})
_CLOTH: Final = frozenset({"bed", "sofa", "armchair", "ottoman", "carpet", "booth", "bench", "pillow"})
_PANEL_M: Final = 0.1
_PANE_M: Final = 0.03
"""Thinner walls are door panels (first) and window panes (second)."""


_CHASSIS: Final = (0.78, 0.16, 0.14, 1.0)
_OWN_LINKS: Final = frozenset({"base", "stage", "carriage"})


class VisualScene:
    """Visual bodies of one scene in one client. A context manager that frees the client."""

    def __init__(self, scene: Scene) -> None:
        """Connect an empty client. Raises EngineError if pybullet is missing."""
        self.scene = scene
        self._bullet = connect(renders=True)
        self._shapes: dict[tuple[object, ...], int] = {}
        self._solids: dict[str, list[tuple[int, ConvexPart]]] = {}

    def __enter__(self) -> VisualScene:
        return self

    def __exit__(self, *_: object) -> None:
        self._bullet.disconnect()

    def add_floors(self) -> None:
        """Add a slab for each room, in alternating colours."""
        for number, room in enumerate(self.scene.rooms):
            size = (room.size_m[0] + 0.12, room.size_m[1] + 0.12, 0.04)
            self.add_solid(Shape.BOX, size, Pose((*room.center_m, -0.02)), _FLOORS[number % len(_FLOORS)])

    def add_walls(self, seen_as: Callable[[ConvexPart], ConvexPart | None]) -> None:
        """Add walls, and leaves of the doors between rooms, as ``seen_as`` returns them; None leaves one out."""
        for wall in (*self.scene.walls, *door_leaves(self.scene)):
            seen = seen_as(wall)
            if seen is not None:
                self._add_part(seen, IDENTITY, _material(wall))

    def add_objects(self, visible: Callable[[SceneObject], bool] = lambda item: True) -> None:
        """Add the objects at their initial places; absent ones are out of sight."""
        for item in self.scene.objects:
            if not visible(item):
                continue
            asset = self.scene.assets[item.asset_id]
            colors = iter(part_colors(asset))
            self._solids[item.name] = [
                (self._add_part(part, OUT_OF_SIGHT, next(colors)), part)
                for link in asset.links
                for part in link.parts
            ]
            if not item.absent:
                self.put(item.name, item.pose_world_asset, item.joints)

    def add_background(self) -> None:
        """Add the background objects at their places."""
        for item in self.scene.background:
            asset = self.scene.assets[item.asset_id]
            # Books of one category stand side by side: each model has its own colour.
            color = _hue(zlib.crc32(item.asset_id.encode()) / 2**32) if is_small(asset) else _color_of(asset)
            for link in asset.links:
                for part in link.parts:
                    self._add_part(part, item.pose_world_asset, color)

    def put(self, name: str, pose: Pose, fractions: Sequence[float] = ()) -> None:
        """Show an object at a pose in the world, its joints at shares of their travel; unknown solids stay unseen."""
        solids = iter(self._solids.get(name, ()))
        asset = self.scene.asset_of(name)
        shares = iter(fractions or (0.0,) * len(asset.joints))
        for link in asset.links:
            frame = pose if link.joint is None else pose @ joint_motion(link.joint, next(shares))
            for _, (body, part) in zip(link.parts, solids, strict=False):
                self._place(body, frame @ part.pose)

    def hide(self, name: str) -> None:
        """Take an object out of sight."""
        for body, _ in self._solids.get(name, ()):
            self._place(body, OUT_OF_SIGHT)

    def add_robot(self) -> RobotFigure:
        """Add the robot, out of sight at first."""
        return RobotFigure(self._bullet)

    def add_solid(
        self, shape: Shape, size_m: Vec3, pose: Pose, color: Rgba, vertices_m: tuple[Vec3, ...] = ()
    ) -> int:
        """Add one visual body and return its id."""
        key = (shape, size_m, vertices_m, color)
        if key not in self._shapes:
            self._shapes[key] = self._visual(shape, size_m, color, vertices_m)
        body = self._bullet.createMultiBody(
            0.0, -1, self._shapes[key], basePosition=pose.position_m, baseOrientation=pose.quat_xyzw
        )
        return int(body)

    def shoot(
        self, view: Sequence[float], lens: Sequence[float], width_px: int, height_px: int
    ) -> NDArray[np.uint8]:
        """Render through a view and a projection matrix: RGB values, shape (height, width, 3)."""
        image = self._bullet.getCameraImage(
            width_px,
            height_px,
            view,
            lens,
            shadow=0,
            lightDirection=(0.5, -0.8, 2.0),
            renderer=self._bullet.ER_TINY_RENDERER,
            flags=self._bullet.ER_NO_SEGMENTATION_MASK,
        )
        pixels = np.asarray(image[2], dtype=np.uint8).reshape(height_px, width_px, 4)
        return np.ascontiguousarray(pixels[..., :3])

    def look_at(self, eye: Sequence[float], target: Sequence[float]) -> list[float]:
        """View matrix of a camera at ``eye`` that looks at ``target``, z up."""
        return list(self._bullet.computeViewMatrix(list(eye), list(target), [0.0, 0.0, 1.0]))

    def lens(self, field_of_view_deg: float, aspect: float, near_m: float, far_m: float) -> list[float]:
        """Projection matrix of a perspective camera; the field of view is vertical."""
        return list(self._bullet.computeProjectionMatrixFOV(field_of_view_deg, aspect, near_m, far_m))

    def _add_part(self, part: ConvexPart, frame: Pose, color: Rgba) -> int:
        return self.add_solid(part.shape, part.size_m, frame @ part.pose, color, part.vertices_m)

    def _place(self, body: int, pose: Pose) -> None:
        self._bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw)

    def _visual(self, shape: Shape, size_m: Vec3, color: Rgba, vertices_m: tuple[Vec3, ...]) -> int:
        bullet = self._bullet
        look = {"rgbaColor": color, "specularColor": (0, 0, 0)}
        match shape:
            case Shape.BOX:
                half = tuple(max(extent, 0.002) / 2 for extent in size_m)
                return int(bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=half, **look))
            case Shape.CYLINDER:
                size = {"radius": size_m[0] / 2, "length": size_m[2]}
                return int(bullet.createVisualShape(bullet.GEOM_CYLINDER, **size, **look))
            case Shape.SPHERE:
                return int(bullet.createVisualShape(bullet.GEOM_SPHERE, radius=size_m[0] / 2, **look))
            case Shape.HULL:
                mesh = _faces(np.asarray(vertices_m))
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


def _material(wall: ConvexPart) -> Rgba:
    """Colour of a wall's part by its thickness."""
    thickness = min(wall.size_m[:2])
    if thickness < _PANE_M:
        return _GLASS
    return _DOOR if thickness < _PANEL_M else _WALL


def part_colors(asset: Asset) -> list[Rgba]:
    """Colours of the parts of all links: panels and drawers stand out from the body that they close, glass from its frame."""
    if asset.category in _MIRRORS:
        parts = [part for link in asset.links for part in link.parts]
        glass = max(parts, key=lambda part: part.size_m[1] * part.size_m[2])
        return [_MIRROR if part is glass else _FRAME for part in parts]
    color = _color_of(asset)
    return [
        color if number == 0 else _lighter(color)
        for number, link in enumerate(asset.links)
        for _ in link.parts
    ]


def _color_of(asset: Asset) -> Rgba:
    """Colour by function; small objects get a vivid colour from their category."""
    if is_small(asset):
        return _hue(zlib.crc32(asset.category.encode()) / 2**32)
    if asset.category in _CLOTH:
        return _SOFT
    if asset.category in _PLANTS:
        return _LEAVES
    if asset.can("openable"):
        return _OPENS
    return _WORKS if asset.can("toggleable") or asset.can("heatSource") else _RESTS


def is_small(asset: Asset) -> bool:
    """Return True for a small object, which gets a vivid colour."""
    return max(asset.size_m) < 0.6 and asset.mass_kg <= ROBOT.mass_kg


def _hue(share: float) -> Rgba:
    red, green, blue = (0.5 + 0.4 * math.cos(2 * math.pi * (share + shift)) for shift in (0.0, 1 / 3, 2 / 3))
    return (red, green, blue, 1.0)


def _lighter(color: Rgba) -> Rgba:
    red, green, blue = (channel + 0.3 * (1.0 - channel) for channel in color[:3])
    return (red, green, blue, 1.0)


class RobotFigure:
    """Robot in a client with Bullet's renderer, for the client's lifetime."""

    def __init__(self, client: BulletClient) -> None:
        """Load the robot, out of sight. Raises EngineMissingError if its description is not installed."""
        self._bullet = client
        self._body = load_robot(client, visuals=True)
        joints: dict[str, int] = {}
        for number in range(client.getNumJoints(self._body)):
            info = client.getJointInfo(self._body, number)
            joints[info[1].decode()] = number
            if info[12].decode() in _OWN_LINKS:
                client.changeVisualShape(self._body, number, rgbaColor=_CHASSIS)
        self._driven = [joints[name] for name in DRIVEN_JOINTS]
        self.leave()

    def stand(self, posture: Posture) -> None:
        """Show the robot in a posture."""
        self._put(0.0)
        for joint, value in zip(self._driven, spread(posture), strict=True):
            self._bullet.resetJointState(self._body, joint, value)

    def leave(self) -> None:
        """Hide the robot: its own camera does not see it."""
        self._put(-100.0)

    def _put(self, height_m: float) -> None:
        self._bullet.resetBasePositionAndOrientation(self._body, (0.0, 0.0, height_m), (0.0, 0.0, 0.0, 1.0))
