"""Poses, boxes and convex parts of a scene.

Units are metres and radians. Frames are right-handed with z up. A pose named ``pose_a_b`` is the pose of frame b in frame a,
so neighbouring names match in a product: ``pose_world_b = pose_world_a @ pose_a_b``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

IDENTITY_QUAT: Final[Quat] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """Rigid transform: the pose of one frame in another. The quaternion is (x, y, z, w) and has unit length."""

    position_m: Vec3
    quat_xyzw: Quat = IDENTITY_QUAT

    def __init__(self, position_m: Vec3, quat_xyzw: Quat = IDENTITY_QUAT) -> None:
        _set_position(self, position_m)
        _set_quat(self, quat_xyzw)

    @staticmethod
    def from_xyz_yaw(x: float, y: float, z: float, yaw: float) -> Pose:
        """Upright pose at (x, y, z), turned by ``yaw`` radians about z."""
        return Pose((x, y, z), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))

    @staticmethod
    def from_rotation(position_m: Vec3, rotation: FloatArray) -> Pose:
        """Pose with a rotation matrix, shape (3, 3): Bar-Itzhack, New Method for Extracting the Quaternion, 2000."""
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        symmetric = np.array(
            [
                [a - e - i, d + b, g + c, h - f],
                [d + b, e - a - i, h + f, c - g],
                [g + c, h + f, i - a - e, d - b],
                [h - f, c - g, d - b, a + e + i],
            ]
        )
        x, y, z, w = np.linalg.eigh(symmetric)[1][:, -1].tolist()
        return Pose(position_m, (x, y, z, w))

    @property
    def yaw(self) -> float:
        """Rotation about z in (-pi, pi], exact for upright poses."""
        x, y, z, w = self.quat_xyzw
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrix, shape (3, 3)."""
        x, y, z, w = self.quat_xyzw
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.apply(other.position_m), _quat_product(self.quat_xyzw, other.quat_xyzw))

    def inverse(self) -> Pose:
        x, y, z, w = self.quat_xyzw
        back = (-x, -y, -z, w)
        px, py, pz = self.position_m
        return Pose(_rotate(back, (-px, -py, -pz)), back)

    def apply(self, point: Vec3) -> Vec3:
        """Map one point of the inner frame into the outer one."""
        x, y, z = _rotate(self.quat_xyzw, point)
        px, py, pz = self.position_m
        return (px + x, py + y, pz + z)

    def apply_all(self, points: FloatArray) -> FloatArray:
        """Map points, shape (n, 3), into the outer frame."""
        return np.asarray(points @ self.rotation.T + np.asarray(self.position_m), dtype=np.float64)


def _writer(owner: type, field: str) -> Callable[[object, object], None]:
    """Setter of a slot in a frozen class, three times as fast as a dataclass's own ``__init__``.

    A rollout makes many hundreds of poses and boxes.
    """
    write: Callable[[object, object], None] = vars(owner)[field].__set__
    return write


_set_position: Final = _writer(Pose, "position_m")
_set_quat: Final = _writer(Pose, "quat_xyzw")

IDENTITY: Final = Pose((0.0, 0.0, 0.0))


def _quat_product(a: Quat, b: Quat) -> Quat:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _rotate(q: Quat, v: Vec3) -> Vec3:
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


@dataclass(frozen=True, slots=True)
class Aabb:
    """Axis-aligned box, ``low_m <= high_m`` on every axis."""

    low_m: Vec3
    high_m: Vec3

    def __init__(self, low_m: Vec3, high_m: Vec3) -> None:
        _set_low(self, low_m)
        _set_high(self, high_m)

    @property
    def center_m(self) -> Vec3:
        (a, b, c), (d, e, f) = self.low_m, self.high_m
        return ((a + d) / 2, (b + e) / 2, (c + f) / 2)

    @property
    def size_m(self) -> Vec3:
        (a, b, c), (d, e, f) = self.low_m, self.high_m
        return (d - a, e - b, f - c)

    def contains(self, point: Vec3, margin_m: float = 0.0) -> bool:
        """Return True if the point lies inside the box grown by ``margin_m``."""
        return all(
            lo - margin_m <= p <= hi + margin_m
            for lo, p, hi in zip(self.low_m, point, self.high_m, strict=True)
        )

    def level_distance_m(self, x: float, y: float) -> float:
        """Horizontal distance from a point of the plane to the box; 0 over or under it."""
        dx = max(self.low_m[0] - x, x - self.high_m[0], 0.0)
        dy = max(self.low_m[1] - y, y - self.high_m[1], 0.0)
        return math.hypot(dx, dy)

    def grown(self, margin_m: float) -> Aabb:
        """Box with ``margin_m`` added on every side."""
        (a, b, c), (d, e, f) = self.low_m, self.high_m
        return Aabb((a - margin_m, b - margin_m, c - margin_m), (d + margin_m, e + margin_m, f + margin_m))

    def overlaps(self, other: Aabb, margin_m: float = 0.0) -> bool:
        """Return True if the boxes, ``margin_m`` apart or less, share volume or a face."""
        (a, b, c), (d, e, f) = self.low_m, self.high_m
        (x, y, z), (u, v, w) = other.low_m, other.high_m
        return (
            a - margin_m <= u
            and x - margin_m <= d
            and b - margin_m <= v
            and y - margin_m <= e
            and c - margin_m <= w
            and z - margin_m <= f
        )

    @staticmethod
    def around(boxes: Iterable[Aabb]) -> Aabb:
        """Smallest box around all of them. Raises ValueError for no boxes."""
        items = list(boxes)
        if not items:
            raise ValueError("no boxes to enclose: expected at least one")
        lows = zip(*[box.low_m for box in items], strict=True)
        highs = zip(*[box.high_m for box in items], strict=True)
        return Aabb(tuple(map(min, lows)), tuple(map(max, highs)))


_set_low: Final = _writer(Aabb, "low_m")
_set_high: Final = _writer(Aabb, "high_m")


def _vec3(values: FloatArray) -> Vec3:
    return (float(values[0]), float(values[1]), float(values[2]))


class Shape(StrEnum):
    """Convex primitives that Bullet collides exactly."""

    BOX = "box"
    CYLINDER = "cylinder"  # axis along z
    SPHERE = "sphere"
    HULL = "hull"  # convex hull of the part's vertices


@dataclass(frozen=True, slots=True)
class ConvexPart:
    """Convex piece of a link, in the asset's frame with every joint at zero.

    ``size_m`` is the full extent: (x, y, z) of a box, (d, d, height) of a cylinder, (d, d, d) of a sphere and the bounding box
    of a hull. Only hulls have ``vertices_m``, in the part's own frame.
    """

    shape: Shape
    pose: Pose
    size_m: Vec3
    vertices_m: tuple[Vec3, ...] = ()

    def corners(self) -> FloatArray:
        """Vertices of a hull, or corners of the box around another shape, in the part's frame; shape (n, 3)."""
        if self.vertices_m:
            return np.asarray(self.vertices_m, dtype=np.float64)
        x, y, z = (extent / 2 for extent in self.size_m)
        return np.array([(sx * x, sy * y, sz * z) for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)])

    def aabb(self, pose_world_asset: Pose) -> Aabb:
        """World bounding box: exact for boxes and hulls; that of the enclosing box for round shapes."""
        world = (pose_world_asset @ self.pose).apply_all(self.corners())  # (n, 3)
        return Aabb(_vec3(world.min(axis=0)), _vec3(world.max(axis=0)))
