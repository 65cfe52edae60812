"""Where the hand may touch a thing to take it, and on which way it comes there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical.reach import Track
from embomatrix.sim.physical.space import part_boxes
from embomatrix.world.geometry import Shape

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import FloatArray, Pose

OPEN_ELEVATIONS: Final = (30.0, 50.0, 10.0, 70.0, 90.0)
ROOFED_ELEVATIONS: Final = (15.0, 30.0, 0.0, 45.0, 60.0)
"""Degrees by which the hand comes from above, in the order of preference."""
OPEN_AZIMUTHS: Final = (0.0, 40.0, -40.0, 80.0, -80.0)
ROOFED_AZIMUTHS: Final = (0.0, 25.0, -25.0)
"""Degrees by which it comes from aside."""
ROLLS: Final = (0.0, 90.0)
STEEP: Final = 70.0
STEEP_ROLLS: Final = (0.0, 90.0, 45.0, -45.0)
"""From so steeply above the hand has no way of its own to lie: it comes between things as there is room."""
FORWARD: Final = 0.35
"""The front of a thing is this share of its depth before its middle."""
OPEN_BACK_M: Final = 0.10
PIT_BACK_M: Final = 0.28
"""Between tall things the hand comes straight down, from higher than they are."""
BEYOND_M: Final = 0.015
"""The way ends this far behind the surface: the hand stops when it touches."""
SHEET_M: Final = 0.004
"""It ends no farther behind than the thing is thick there, but at least this far: a sheet of paper lies on something."""
HOLLOW_M: Final = 0.12
"""Round things and hulls do not fill their boxes: to those it leads on to half their thickness, up to this far."""


def cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Cross product of two vectors, (3,): in numbers, as numpy's own spends its time on shapes."""
    (a, b, c), (d, e, f) = one.tolist(), other.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def facing(direction: FloatArray, roll: float, aside: FloatArray) -> FloatArray:
    """Rotation, (3, 3), of a tool whose z axis points along a direction and whose y axis is level, turned by ``roll``."""
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
    """Where a ray through a point first meets any of the boxes, how thick that box is there, and its number: slab test.

    None when it misses them all.
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


def grasp_tracks(
    asset: Asset, pose: Pose, fractions: Sequence[float], course: float, out_m: float | None
) -> list[Track]:
    """Ways of the tool to the thing's surface, the preferred ones first: far, half way, at it, a little beyond.

    ``course`` is the heading, in the world, in which the hand goes; ``out_m`` the length of the way in when the thing stands
    under a roof, None in the open.
    """
    body = _Body(
        part_boxes(asset, pose, fractions), [part.shape for link in asset.links for part in link.parts]
    )
    inward = None if out_m is None else _direction(course, 0.0)
    aims = list(_aims(asset, pose, body.boxes, inward))
    tracks: list[Track] = []
    for azimuth in OPEN_AZIMUTHS if out_m is None else ROOFED_AZIMUTHS:
        for elevation in OPEN_ELEVATIONS if out_m is None else ROOFED_ELEVATIONS:
            if elevation == 90.0 and azimuth != 0.0:
                continue
            direction = _direction(course + math.radians(azimuth), math.radians(elevation))
            back = direction * OPEN_BACK_M if inward is None or out_m is None else inward * out_m
            rolls = ROLLS if elevation < STEEP else STEEP_ROLLS
            tracks += body.approaches(aims, direction, back, rolls, course)
    if out_m is None:
        for elevation in (90.0, STEEP):
            direction = _direction(course, math.radians(elevation))
            back = np.array([0.0, 0.0, -PIT_BACK_M])
            tracks += body.approaches(aims[:1], direction, back, STEEP_ROLLS, course)
    return tracks


@dataclass(frozen=True, slots=True)
class _Body:
    """Boxes around the parts of a thing in the world, and the parts' shapes."""

    boxes: Sequence[tuple[Pose, tuple[float, float, float]]]
    shapes: Sequence[Shape]

    def approaches(
        self,
        aims: Sequence[FloatArray],
        direction: FloatArray,
        back: FloatArray,
        rolls: Sequence[float],
        course: float,
    ) -> Iterator[Track]:
        """Ways on which the hand goes for each of the aims: ``back``, (3,), is how it comes near."""
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


def _approach(rotation: FloatArray, point: FloatArray, end: FloatArray, back: FloatArray) -> Track:
    near = point - 0.03 * rotation[:, 2]
    count = max(2, math.ceil(float(np.linalg.norm(back)) / 0.12) + 1)
    steps = np.linspace(1.0, 0.0, count)[:, None]
    positions = np.concatenate([near - steps * back, [point, end]])
    total = len(positions)
    return Track(np.tile(rotation, (total, 1, 1)), positions, np.zeros(total, dtype=bool), total - 2)


def _aims(
    asset: Asset,
    pose: Pose,
    boxes: Sequence[tuple[Pose, tuple[float, float, float]]],
    inward: FloatArray | None,
) -> Iterator[FloatArray]:
    """Points of the thing that the hand goes for: its middle, then the middles of its largest parts.

    Where the hand goes inward under a roof, what is nearer to the front comes next after the middle.
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
