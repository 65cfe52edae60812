"""Grasp candidates: contact points of the hand on an object, and the tool paths to them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.physical.reach import ToolPath
from embomatrix.sim.physical.space import part_boxes
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import FloatArray, Pose, Shape

OPEN_ELEVATIONS: Final = (30.0, 50.0, 10.0, 70.0, 90.0)
ROOFED_ELEVATIONS: Final = (15.0, 30.0, 0.0, 45.0, 60.0)
"""Angles, in degrees, by which the hand comes from above, in the order of preference."""
OPEN_AZIMUTHS: Final = (0.0, 40.0, -40.0, 80.0, -80.0)
ROOFED_AZIMUTHS: Final = (0.0, 25.0, -25.0)
"""Angles, in degrees, by which the hand comes from the side."""
ROLLS: Final = (0.0, 90.0)
STEEP: Final = 70.0
STEEP_ROLLS: Final = (0.0, 90.0, 45.0, -45.0)
"""Rolls of a steep hand: it has no preferred roll and fits between objects where there is room."""
FORWARD: Final = 0.35
"""Distance of the front grasp point from the middle, as a share of the object's depth."""
OPEN_BACK_M: Final = 0.10
PIT_BACK_M: Final = 0.28
"""Height from which the hand comes straight down between tall objects."""
BEYOND_M: Final = 0.015
"""Distance behind the surface at which the tool path ends. The hand stops when it touches."""
SHEET_M: Final = 0.004
"""Least distance behind the surface. The path ends no deeper than the object is thick, because a sheet lies on something."""
HOLLOW_M: Final = 0.12
"""Largest distance behind the surface for round parts and hulls, which do not fill their boxes."""


def cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Cross product of two vectors, (3,), in plain numbers: faster than numpy for single vectors."""
    (a, b, c), (d, e, f) = one.tolist(), other.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def facing(direction: FloatArray, roll: float, aside: FloatArray) -> FloatArray:
    """Return the rotation, (3, 3), of a tool with z along a direction and a level y axis, turned by ``roll``."""
    level = np.array([-direction[1], direction[0], 0.0])
    if np.linalg.norm(level) < 0.05:
        level = aside
    level = level / np.linalg.norm(level)
    across = cross(level, direction)
    y = math.cos(roll) * level + math.sin(roll) * across
    return np.array([cross(y, direction), y, direction]).T


def surface_point(
    boxes: Sequence[tuple[Pose, tuple[float, float, float]]], aim: FloatArray, direction: FloatArray
) -> tuple[FloatArray, float, int] | None:
    """Return the first intersection of a ray with boxes, the thickness of that box along the ray, and its index; None for none.

    Slab test. ``aim``: point on the ray; ``direction``: unit vector.
    """
    start = aim - 3.0 * direction
    nearest, thick_m, met = math.inf, 0.0, 0
    for number, (pose, size) in enumerate(boxes):
        back = pose.rotation.T
        origin, course = back @ (start - np.array(pose.position_m)), back @ direction
        course = np.where(np.abs(course) < 1e-9, 1e-9, course)
        half = np.array(size) / 2
        first, second = (-half - origin) / course, (half - origin) / course
        enter, leave = np.minimum(first, second).max(), np.maximum(first, second).min()
        if enter <= leave and enter < nearest:
            nearest, thick_m, met = float(enter), float(leave - enter), number
    return (start + nearest * direction, thick_m, met) if math.isfinite(nearest) else None


def grasp_tool_paths(
    asset: Asset, pose: Pose, fractions: Sequence[float], course: float, depth_m: float | None
) -> list[ToolPath]:
    """Return tool paths to the surface of an object, preferred ones first: far, half-way, at the surface, a little beyond.

    ``course``: heading of the hand in the world. ``depth_m``: length of the entry under a roof, None in the open.
    """
    body = _Body(
        part_boxes(asset, pose, fractions), [part.shape for link in asset.links for part in link.parts]
    )
    inward = None if depth_m is None else _direction(course, 0.0)
    aims = list(_aims(asset, pose, body.boxes, inward))
    tool_paths: list[ToolPath] = []
    for azimuth in OPEN_AZIMUTHS if depth_m is None else ROOFED_AZIMUTHS:
        for elevation in OPEN_ELEVATIONS if depth_m is None else ROOFED_ELEVATIONS:
            if elevation == 90.0 and azimuth != 0.0:
                continue
            direction = _direction(course + math.radians(azimuth), math.radians(elevation))
            back = direction * OPEN_BACK_M if inward is None or depth_m is None else inward * depth_m
            rolls = ROLLS if elevation < STEEP else STEEP_ROLLS
            tool_paths += body.approaches(aims, direction, back, rolls, course)
    if depth_m is None:
        for elevation in (90.0, STEEP):
            direction = _direction(course, math.radians(elevation))
            back = np.array([0.0, 0.0, -PIT_BACK_M])
            tool_paths += body.approaches(aims[:1], direction, back, STEEP_ROLLS, course)
    return tool_paths


@dataclass(frozen=True, slots=True)
class _Body:
    """Boxes around the parts of an object in the world, and the shapes of the parts."""

    boxes: Sequence[tuple[Pose, tuple[float, float, float]]]
    shapes: Sequence[Shape]

    def approaches(
        self,
        aims: Sequence[FloatArray],
        direction: FloatArray,
        back: FloatArray,
        rolls: Sequence[float],
        course: float,
    ) -> Iterator[ToolPath]:
        """Yield tool paths to each aim. ``back``, (3,), is the displacement of the approach."""
        aside = np.array([-math.sin(course), math.cos(course), 0.0])
        for aim in aims:
            met = surface_point(self.boxes, aim, direction)
            if met is None:
                continue
            point, thick_m, number = met
            beyond_m = min(max(thick_m, SHEET_M), BEYOND_M)
            if self.shapes[number] is not Shape.BOX:
                beyond_m = max(beyond_m, min(thick_m / 2, HOLLOW_M))
            for roll in rolls:
                rotation = facing(direction, math.radians(roll), aside)
                yield _approach(rotation, point, point + beyond_m * direction, back)


def _approach(rotation: FloatArray, point: FloatArray, end: FloatArray, back: FloatArray) -> ToolPath:
    near = point - 0.03 * rotation[:, 2]
    count = max(2, math.ceil(float(np.linalg.norm(back)) / 0.12) + 1)
    steps = np.linspace(1.0, 0.0, count)[:, None]
    positions = np.concatenate([near - steps * back, [point, end]])
    total = len(positions)
    return ToolPath(np.tile(rotation, (total, 1, 1)), positions, np.zeros(total, dtype=bool), total - 2)


def _aims(
    asset: Asset,
    pose: Pose,
    boxes: Sequence[tuple[Pose, tuple[float, float, float]]],
    inward: FloatArray | None,
) -> Iterator[FloatArray]:
    """Yield grasp points: the middle of the object, then the middles of its largest parts.

    Under a roof, a point nearer to the front comes second.
    """
    middle = np.array(pose.position_m)
    yield middle
    if inward is not None:
        depth = float(np.abs(pose.rotation.T @ inward) @ np.array(asset.size_m))
        yield middle - FORWARD * depth * inward
    yield middle + np.array([0.0, 0.0, 0.25 * asset.size_m[2]])
    sizes = [size[0] * size[1] * size[2] for _, size in boxes]
    for number in np.argsort(sizes)[::-1][: 3 if len(boxes) > 1 else 0].tolist():
        yield np.array(boxes[number][0].position_m)


def _direction(course: float, down: float) -> FloatArray:
    return np.array([math.cos(course) * math.cos(down), math.sin(course) * math.cos(down), -math.sin(down)])
