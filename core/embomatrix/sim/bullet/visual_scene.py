"""Visual bodies of a scene in a separate client, for pictures: the simulation has no visuals.

Every solid is a body without a collision shape. Shapes are shared; objects can be moved, opened and hidden between pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from embomatrix.sim.bullet.client import BulletClient, connect
from embomatrix.sim.bullet.robot import Posture, load_robot, spread
from embomatrix.sim.bullet.robot_model import DRIVEN_JOINTS
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.sim.geometry.door_leaves import door_leaves
from embomatrix.sim.looks.materials import Material
from embomatrix.sim.looks.parts import part_materials
from embomatrix.sim.looks.rooms import CEILING, DOOR_PANEL, PANE, WALL, floor_of
from embomatrix.sim.looks.surfaces import THINNEST_M
from embomatrix.sim.looks.view import View
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, Pose, Shape, Vec3
from embomatrix.world.scene import BackgroundObject, Scene, SceneObject

FloatArray = NDArray[np.float64]

OUT_OF_SIGHT: Final = Pose((0.0, 0.0, -100.0))

_PANEL_M: Final = 0.1
_PANE_M: Final = 0.03
"""Thinner walls are door panels (first) and window panes (second)."""
_AMBIENT: Final = 0.68
_DIFFUSE: Final = 0.32
"""Shares of a colour that surfaces show in flat pictures, away from the light and towards it."""
_CEILING_M: Final = 0.02
"""Height of a ceiling above the tops of its walls."""


_CHASSIS: Final = (0.78, 0.16, 0.14, 1.0)
_OWN_LINKS: Final = frozenset({"base", "stage", "carriage"})


@dataclass(frozen=True, slots=True)
class SeenPart:
    """Part of a picture: its shape, its place in the world and its material."""

    part: ConvexPart
    pose: Pose
    material: Material


@dataclass(frozen=True)
class Buffers:
    """Buffers of Bullet's renderer: RGB values, depth values and body numbers, -1 for none; shape (height, width)."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    body: NDArray[np.int32]


class VisualScene:
    """Visual bodies of one scene in one client. A context manager that frees the client."""

    def __init__(self, scene: Scene) -> None:
        """Connect an empty client. Raises EngineError if pybullet is missing."""
        self.scene = scene
        self._bullet = connect(renders=True)
        self._shapes: dict[tuple[object, ...], int] = {}
        self._solids: dict[str, list[tuple[int, ConvexPart]]] = {}
        self.parts: dict[int, SeenPart] = {}
        """Part of each body but the robot's."""
        self.owners: dict[int, str] = {}
        """Name of the object that a body belongs to."""
        self.walls: set[int] = set()
        """Bodies of walls, without doors and panes."""
        self.moves = 0
        """Number of changes of the bodies' places so far."""

    def __enter__(self) -> VisualScene:
        return self

    def __exit__(self, *_: object) -> None:
        self._bullet.disconnect()

    def add_floors(self) -> None:
        """Add a slab for each room, of the material of its type of room."""
        for room in self.scene.rooms:
            size = (room.size_m[0] + 0.12, room.size_m[1] + 0.12, 0.04)
            self._add_box(size, (*room.center_m, -0.02), floor_of(room.type))

    def add_ceilings(self) -> None:
        """Add a ceiling over each room but gardens. Seen from above, it is not there: the renderer shows only its underside."""
        for room in self.scene.rooms:
            if room.type != "garden":
                self._add_ceiling(room.low_m, room.high_m, room.height_m + _CEILING_M)

    def add_walls(self, seen_as: Callable[[ConvexPart], ConvexPart | None]) -> None:
        """Add walls, and leaves of the doors between rooms, as ``seen_as`` returns them; None leaves one out."""
        for wall in (*self.scene.walls, *door_leaves(self.scene)):
            seen = seen_as(wall)
            if seen is not None:
                material = _material(wall)
                body = self._add_part(seen, IDENTITY, material)
                if material is WALL:
                    self.walls.add(body)

    def add_objects(self, visible: Callable[[SceneObject], bool] = lambda item: True) -> None:
        """Add the objects at their initial places; absent ones are out of sight."""
        for item in self.scene.objects:
            if not visible(item):
                continue
            asset = self.scene.assets[item.asset_id]
            materials = iter(part_materials(asset))
            self._solids[item.name] = [
                (self._add_part(part, OUT_OF_SIGHT, next(materials)), part)
                for link in asset.links
                for part in link.parts
            ]
            self.owners.update((body, item.name) for body, _ in self._solids[item.name])
            if not item.absent:
                self.put(item.name, item.pose_world_asset, item.joints)

    def add_background(
        self, visible: Callable[[BackgroundObject, Aabb], bool] = lambda item, box: True
    ) -> None:
        """Add the background objects at their places. ``visible`` is asked with each one's world box."""
        for item, box in zip(self.scene.background, self.scene.background_boxes, strict=True):
            if not visible(item, box):
                continue
            asset = self.scene.assets[item.asset_id]
            materials = iter(part_materials(asset))
            for link in asset.links:
                for part in link.parts:
                    self._add_part(part, item.pose_world_asset, next(materials))

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

    def shoot(self, view: View, width_px: int, height_px: int) -> NDArray[np.uint8]:
        """Render a view: RGB values, shape (height, width, 3), flat colours without shadows."""
        return np.ascontiguousarray(self.capture(view, width_px, height_px).color)

    def capture(self, view: View, width_px: int, height_px: int) -> Buffers:
        """Render the buffers of a view."""
        image = self._bullet.getCameraImage(
            width_px,
            height_px,
            view.view_matrix,
            view.lens_matrix,
            shadow=0,
            lightDirection=(0.5, -0.8, 2.0),
            lightAmbientCoeff=_AMBIENT,
            lightDiffuseCoeff=_DIFFUSE,
            renderer=self._bullet.ER_TINY_RENDERER,
        )
        size = (height_px, width_px)
        return Buffers(
            np.asarray(image[2], np.uint8).reshape(*size, 4)[..., :3],
            np.asarray(image[3], np.float32).reshape(size),
            np.asarray(image[4], np.int32).reshape(size),
        )

    def _add_box(self, size_m: Vec3, center_m: Vec3, material: Material) -> int:
        return self._add_part(ConvexPart(Shape.BOX, IDENTITY, size_m), Pose(center_m), material)

    def _add_ceiling(self, low_m: tuple[float, float], high_m: tuple[float, float], height_m: float) -> None:
        (a, b), (c, d) = low_m, high_m
        mesh = {
            "vertices": [(a, b, height_m), (a, d, height_m), (c, d, height_m), (c, b, height_m)],
            "indices": [0, 1, 2, 0, 2, 3],
            "normals": [(0.0, 0.0, -1.0)] * 4,
        }
        look = {"rgbaColor": (*CEILING.color, 1.0), "specularColor": (0, 0, 0)}
        shape = self._bullet.createVisualShape(self._bullet.GEOM_MESH, **mesh, **look)
        body = int(self._bullet.createMultiBody(0.0, -1, shape))
        size = (c - a, d - b, 0.002)
        pose = Pose(((a + c) / 2, (b + d) / 2, height_m))
        self.parts[body] = SeenPart(ConvexPart(Shape.BOX, IDENTITY, size), pose, CEILING)

    def _add_part(self, part: ConvexPart, frame: Pose, material: Material) -> int:
        """Add one visual body and return its number."""
        key = (part.shape, part.size_m, part.vertices_m, material.color)
        if key not in self._shapes:
            self._shapes[key] = self._visual(part.shape, part.size_m, (*material.color, 1.0), part.vertices_m)
        pose = frame @ part.pose
        body = int(
            self._bullet.createMultiBody(
                0.0, -1, self._shapes[key], basePosition=pose.position_m, baseOrientation=pose.quat_xyzw
            )
        )
        self.parts[body] = SeenPart(part, pose, material)
        self.moves += 1
        return body

    def _place(self, body: int, pose: Pose) -> None:
        self._bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw)
        self.parts[body] = replace(self.parts[body], pose=pose)
        self.moves += 1

    def _visual(
        self,
        shape: Shape,
        size_m: Vec3,
        color: tuple[float, float, float, float],
        vertices_m: tuple[Vec3, ...],
    ) -> int:
        bullet = self._bullet
        look = {"rgbaColor": color, "specularColor": (0, 0, 0)}
        match shape:
            case Shape.BOX:
                half = tuple(max(extent, THINNEST_M) / 2 for extent in size_m)
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


def _material(wall: ConvexPart) -> Material:
    """Material of a wall's part by its thickness."""
    thickness = min(wall.size_m[:2])
    if thickness < _PANE_M:
        return PANE
    return DOOR_PANEL if thickness < _PANEL_M else WALL


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
