"""Bounding boxes of assets at any pose and joint position, exact except for the rims of tilted cylinders.

They derive from the parts: the physics engine's boxes include collision margins and grow as compounds turn.
"""

import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.caches import BoundedCache
from embomatrix.world.asset import Asset, Joint, JointKind
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, FloatArray, Pose, Quat, Shape, Vec3

IntArray = NDArray[np.int64]
Turned = tuple[Quat, tuple[float, ...]]
"""Quaternion of an asset's frame and its joint positions: objects stand at few angles."""
Corners = tuple[Vec3, Vec3]
"""Low and high corner of a box, relative to the asset's origin."""

RIM_POINTS: Final = 24
"""Points on each rim of a cylinder: a box is at most 0.9 % of the radius too small."""
EXTENTS_KEPT: Final = 512
"""Cached answers per asset, about 300 bytes each; for its parts as many each."""
CORNERS: Final = 8
SQUARE: Final = 5e-7
"""Half the angle, in radians, up to which frames count as square to one another."""
ASSETS_KEPT: Final = 512
"""Assets with cached points: more than a scene has, and few enough for a process that loads many scenes."""


def joint_motion(joint: Joint, fraction: float) -> Pose:
    """Displacement of a link in the asset's frame at a share of its joint's travel: identity at 0."""
    travel = fraction * joint.upper
    x, y, z = joint.axis
    if joint.kind is JointKind.PRISMATIC:
        return Pose((x * travel, y * travel, z * travel))
    sine, cosine = math.sin(travel / 2), math.cos(travel / 2)
    turn = Pose(joint.origin_m, (x * sine, y * sine, z * sine, cosine))
    ox, oy, oz = joint.origin_m
    return turn @ Pose((-ox, -oy, -oz))


def square_box(box: Aabb, frame: Pose) -> Aabb | None:
    """Box in the target of ``frame``; None if its sides are not along that frame's axes to within a microradian."""
    x, y, z, w = (abs(value) for value in frame.quat_xyzw)
    if x > SQUARE or y > SQUARE:
        return None
    width, depth, height = box.size_m
    if abs(z - w) <= SQUARE:
        width, depth = depth, width
    elif min(z, w) > SQUARE:
        return None
    cx, cy, cz = frame.apply(box.center_m)
    low = (cx - width / 2, cy - depth / 2, cz - height / 2)
    return Aabb(low, (cx + width / 2, cy + depth / 2, cz + height / 2))


class AssetBounds:
    """Boxes of an asset, of its parts and of its panels, shared by all objects of the asset."""

    def __init__(self, asset: Asset) -> None:
        self._links = [(link.joint, link.parts) for link in asset.links if link.parts]
        self._of_base = len(asset.links[0].parts)
        self._extents = BoundedCache(EXTENTS_KEPT, self._find_extents)
        self._part_extents = BoundedCache(EXTENTS_KEPT, self._find_part_extents)
        self._panel_extents = BoundedCache(EXTENTS_KEPT, self._find_panel_extents)
        self._hull_at = BoundedCache(EXTENTS_KEPT, self._find_hull)

    def box(self, pose: Pose, fractions: Sequence[float] = ()) -> Aabb:
        """Bounding box in the target of ``pose``, with the joints at these shares of their travel."""
        (a, b, c), (d, e, f) = self._extents[pose.quat_xyzw, tuple(fractions)]
        x, y, z = pose.position_m
        return Aabb((x + a, y + b, z + c), (x + d, y + e, z + f))

    def extents(self, rotations: FloatArray, fractions: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
        """Corners of the boxes relative to the origin at rotations of shape (n, 3, 3); each of shape (n, 3)."""
        points, radii = self._hull_at[fractions]
        turned = rotations @ points  # (n, 3, m)
        if radii is None:
            return turned.min(axis=2), turned.max(axis=2)
        return (turned - radii).min(axis=2), (turned + radii).max(axis=2)

    def part_boxes(self, pose: Pose, fractions: Sequence[float]) -> list[Aabb]:
        """World box of every part, in the order of the links; equal to ``ConvexPart.aabb``."""
        return _moved(self._part_extents[pose.quat_xyzw, tuple(fractions)], pose)

    def base_boxes(self, pose: Pose) -> list[Aabb]:
        """World box of every part of the base."""
        return self.part_boxes(pose, ())[: self._of_base]

    def panel_boxes(self, pose: Pose, fractions: Sequence[float]) -> list[Aabb]:
        """World box of every moving link."""
        return _moved(self._panel_extents[pose.quat_xyzw, tuple(fractions)], pose)

    def parts_within(self, pose: Pose, fractions: Sequence[float], box: Aabb) -> list[ConvexPart]:
        """Parts whose boxes overlap a world box, each at its world pose."""
        boxes = iter(self.part_boxes(pose, fractions))
        return [
            ConvexPart(part.shape, frame @ part.pose, part.size_m, part.vertices_m)
            for frame, parts in self._frames(pose, fractions)
            for part, part_box in zip(parts, boxes, strict=False)
            if part_box.overlaps(box)
        ]

    def _find_extents(self, turned_as: Turned) -> Corners:
        quat_xyzw, fractions = turned_as
        points, radii = self._hull_at[fractions]
        turned = Pose(IDENTITY.position_m, quat_xyzw).rotation @ points  # (3, m)
        lows, highs = (turned, turned) if radii is None else (turned - radii, turned + radii)
        # ufunc.reduce directly: the array methods go through Python, which doubles the cost.
        a, b, c = np.minimum.reduce(lows, 1).tolist()
        d, e, f = np.maximum.reduce(highs, 1).tolist()
        return (a, b, c), (d, e, f)

    def _find_part_extents(self, turned_as: Turned) -> list[Corners]:
        quat_xyzw, fractions = turned_as
        points, starts = self._corners
        chunks, first = [], 0
        for frame, parts in self._frames(Pose(IDENTITY.position_m, quat_xyzw), fractions):
            count = sum(len(part.vertices_m) or CORNERS for part in parts)
            chunks.append(frame.apply_all(points[first : first + count]))
            first += count
        world = np.concatenate(chunks)  # (n, 3)
        lows = np.minimum.reduceat(world, starts).tolist()
        highs = np.maximum.reduceat(world, starts).tolist()
        return [((a, b, c), (d, e, f)) for (a, b, c), (d, e, f) in zip(lows, highs, strict=True)]

    def _find_panel_extents(self, turned_as: Turned) -> list[Corners]:
        extents = iter(self._part_extents[turned_as])
        found: list[Corners] = []
        for joint, parts in self._links:
            boxes = [Aabb(low, high) for low, high in itertools.islice(extents, len(parts))]
            if joint is not None:
                box = Aabb.around(boxes)
                found.append((box.low_m, box.high_m))
        return found

    def _find_hull(self, fractions: tuple[float, ...]) -> tuple[FloatArray, FloatArray | None]:
        """Points of all parts in the asset's frame, shape (3, m), and the radii of balls around them; None for no balls.

        The hull of points and balls encloses the asset.
        """
        moving = zip(self._frames(IDENTITY, fractions), self._clouds, strict=True)
        points = np.concatenate([frame.apply_all(cloud) for (frame, _), (cloud, _) in moving])
        radii = np.concatenate([balls for _, balls in self._clouds])
        return np.ascontiguousarray(points.T), radii if radii.any() else None

    @functools.cached_property
    def _clouds(self) -> list[tuple[FloatArray, FloatArray]]:
        return [_cloud(parts) for _, parts in self._links]

    @functools.cached_property
    def _corners(self) -> tuple[FloatArray, IntArray]:
        """Points whose hull encloses each part, shape (n, 3), and the index of each part's first point."""
        corners = [part.pose.apply_all(part.corners()) for _, parts in self._links for part in parts]
        return np.concatenate(corners), np.cumsum([0, *map(len, corners)])[:-1]

    def _frames(
        self, pose: Pose, fractions: Sequence[float]
    ) -> Iterator[tuple[Pose, tuple[ConvexPart, ...]]]:
        """Frame of each link that has parts, and these parts."""
        moving = iter(fractions)
        for joint, parts in self._links:
            fraction = next(moving, 0.0) if joint is not None else 0.0
            placed = pose @ joint_motion(joint, fraction) if joint is not None and fraction else pose
            yield placed, parts


def bounds_of(asset: Asset) -> AssetBounds:
    """Bounds of an asset, made at the first call."""
    known = _KNOWN.get(id(asset))
    if known is None:
        if len(_KNOWN) >= ASSETS_KEPT:
            _KNOWN.clear()
        known = _KNOWN[id(asset)] = (asset, AssetBounds(asset))
    return known[1]


def forget(assets: Iterable[Asset]) -> None:
    """Drop the caches of these assets: a process that loads many scenes would fill up with them."""
    for asset in assets:
        _KNOWN.pop(id(asset), None)


_KNOWN: Final[dict[int, tuple[Asset, AssetBounds]]] = {}
"""Bounds by the asset's id. Holding the asset keeps its id from being reused."""


def _moved(extents: Sequence[Corners], pose: Pose) -> list[Aabb]:
    x, y, z = pose.position_m
    return [Aabb((x + a, y + b, z + c), (x + d, y + e, z + f)) for (a, b, c), (d, e, f) in extents]


def _cloud(parts: Sequence[ConvexPart]) -> tuple[FloatArray, FloatArray]:
    """Points, shape (n, 3), and the radius of the ball around each, shape (n,), in the asset's frame."""
    points = [part.pose.apply_all(_points(part)) for part in parts]
    radii = [
        np.full(len(chunk), part.size_m[0] / 2 if part.shape is Shape.SPHERE else 0.0)
        for part, chunk in zip(parts, points, strict=True)
    ]
    return np.concatenate(points), np.concatenate(radii)


def _points(part: ConvexPart) -> FloatArray:
    x, y, z = (extent / 2 for extent in part.size_m)
    match part.shape:
        case Shape.SPHERE:
            return np.zeros((1, 3))
        case Shape.CYLINDER:
            angles = np.arange(RIM_POINTS) * (2 * math.pi / RIM_POINTS)
            rim = np.stack([x * np.cos(angles), y * np.sin(angles), np.full(RIM_POINTS, z)], axis=1)
            return np.concatenate([rim, rim * (1.0, 1.0, -1.0)])
        case Shape.HULL | Shape.BOX:
            return part.corners()
