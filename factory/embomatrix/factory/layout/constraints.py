"""Placement constraints on a plane: their meaning over arrays of candidate spots, and rules that choose them.

All values are in the plane's frame: origin in the centre, x and y along its sides. An object's front points along its
own +x axis. Weights are those of the paper's released code, which implements three constraints incorrectly. Here
``face_to`` means that the object's front points at the other object. ``near`` and ``far`` use gaps scaled to the
plane, and ``middle`` has an effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.values import (
    ConstraintBrief,
    ConstraintKind,
    ObjectBrief,
    PlacementClass,
    PlacementConstraint,
    PlacementConstraints,
    PlaneFootprint,
    Size2,
    Size3,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


WEIGHTS: Final[Mapping[ConstraintKind, float]] = {
    ConstraintKind.EDGE: 2.0,
    ConstraintKind.MIDDLE: 1.0,
    ConstraintKind.NEAR: 0.5,
    ConstraintKind.FAR: 0.5,
    ConstraintKind.IN_FRONT_OF: 0.5,
    ConstraintKind.SIDE_OF: 0.5,
    ConstraintKind.CENTER_ALIGNED: 1.5,
    ConstraintKind.FACE_TO: 1.5,
    ConstraintKind.NEXT_TO: 1.5,
}
EDGE_M: Final = 0.10
EDGE_SHARE: Final = 0.15
"""``edge``: within 10 cm of a side; on small planes within this share of the shorter side."""
MIDDLE_SHARE: Final = 0.15
"""``middle``: within this share of each side from the plane's centre."""
NEAR_M: Final = 1.0
NEAR_SHARE: Final = 0.25
"""``near``: a gap of at most 1 m; on small planes at most this share of the diagonal. ``far`` is the opposite."""
FACE_RAD: Final = math.radians(5.0)
ALIGNED_RAD: Final = math.radians(5.0)
FRONT_RAD: Final = math.radians(45.0)
NEXT_SHARE: Final = 1 / 6
NEXT_M: Final = (0.05, 0.5)
"""The engine's rule for ``nextto``: a sixth of the mean of the six extents, within these bounds."""
NEXT_SLACK: Final = 0.8
"""Share of the engine's limit that is used. Round objects are farther apart than their boxes."""
GRADED_SHARE: Final = 0.3
"""Share of a weight that grows with partial satisfaction, so that nearly satisfied constraints count."""


@dataclass(frozen=True, slots=True)
class SpotCandidates:
    """Candidate spots of one object: centres (n, 2), yaws (n,), and half extents (n, 2) of the rotated footprint's box."""

    center: FloatArray
    yaw: FloatArray
    half: FloatArray

    @staticmethod
    def of(center: FloatArray, yaw: FloatArray, size_m: Size3) -> SpotCandidates:
        """Return the spots of an object with this size."""
        return SpotCandidates(center, yaw, half_extents(yaw, (size_m[0], size_m[1])))

    def at(self, rows: FloatArray | BoolArray | NDArray[np.int64]) -> SpotCandidates:
        return SpotCandidates(self.center[rows], self.yaw[rows], self.half[rows])

    def __len__(self) -> int:
        return len(self.yaw)


def half_extents(yaw: FloatArray, size_m: Size2) -> FloatArray:
    """Return half extents, shape (n, 2), of the axis-aligned boxes around a rectangle rotated by n yaws."""
    cosine, sine = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
    x, y = size_m[0] / 2, size_m[1] / 2
    return np.stack([cosine * x + sine * y, sine * x + cosine * y], axis=-1)


def margins(spots: SpotCandidates, plane_m: Size2) -> FloatArray:
    """Distance between each spot's box and the nearest side of the plane, shape (n,). It is negative beyond the side."""
    return np.asarray((np.asarray(plane_m) / 2 - np.abs(spots.center) - spots.half).min(axis=1))


def gaps(spots: SpotCandidates, other: PlaneFootprint) -> FloatArray:
    """Distance between each spot's box and another footprint's box, shape (n,); 0 if they overlap."""
    apart = np.abs(spots.center - np.asarray(other.center_m)) - spots.half - _half(other)
    return np.asarray(np.hypot(*np.maximum(apart, 0.0).T))


def near_m(plane_m: Size2) -> float:
    """Return the largest gap in metres at which two objects on a plane of this size are near each other."""
    return min(NEAR_M, NEAR_SHARE * math.hypot(*plane_m))


def holds(
    constraint: PlacementConstraint,
    spots: SpotCandidates,
    plane_m: Size2,
    size_m: Size3,
    other: PlaneFootprint | None,
) -> BoolArray:
    """Mask of spots at which a constraint holds, shape (n,). A constraint about an absent object holds nowhere."""
    if constraint.kind is ConstraintKind.EDGE:
        return margins(spots, plane_m) <= min(EDGE_M, EDGE_SHARE * min(plane_m))
    if constraint.kind is ConstraintKind.MIDDLE:
        return np.asarray((np.abs(spots.center) <= MIDDLE_SHARE * np.asarray(plane_m)).all(axis=1))
    if other is None:
        return np.zeros(len(spots), dtype=bool)
    match constraint.kind:
        case ConstraintKind.NEAR:
            return np.asarray(gaps(spots, other) <= near_m(plane_m))
        case ConstraintKind.FAR:
            return np.asarray(gaps(spots, other) > near_m(plane_m))
        case ConstraintKind.NEXT_TO:
            return _beside(spots, size_m, other)
        case ConstraintKind.IN_FRONT_OF:
            return np.asarray(_off_front(spots, other) <= FRONT_RAD)
        case ConstraintKind.SIDE_OF:
            angle = _off_front(spots, other)
            return np.asarray((angle > FRONT_RAD) & (angle < math.pi - FRONT_RAD))
        case ConstraintKind.FACE_TO:
            return np.asarray(_off_own_front(spots, other) <= FACE_RAD)
        case _:
            return np.asarray(_off_axis(spots, other) <= ALIGNED_RAD)


def satisfaction(
    constraint: PlacementConstraint,
    spots: SpotCandidates,
    plane_m: Size2,
    other: PlaneFootprint | None,
) -> FloatArray:
    """Satisfaction of a constraint at each spot, from 0 to 1, shape (n,). It decreases smoothly with the violation."""
    if constraint.kind is ConstraintKind.EDGE:
        return np.asarray(np.exp(-np.maximum(margins(spots, plane_m), 0.0) / (0.25 * max(plane_m))))
    if constraint.kind is ConstraintKind.MIDDLE:
        return np.asarray(1.0 - np.hypot(*(spots.center / np.asarray(plane_m)).T) * math.sqrt(2))
    if other is None:
        return np.zeros(len(spots))
    match constraint.kind:
        case ConstraintKind.NEAR | ConstraintKind.NEXT_TO:
            return np.asarray(np.exp(-gaps(spots, other) / near_m(plane_m)))
        case ConstraintKind.FAR:
            return np.asarray(1.0 - np.exp(-gaps(spots, other) / near_m(plane_m)))
        case ConstraintKind.IN_FRONT_OF:
            return np.asarray((1.0 + np.cos(_off_front(spots, other))) / 2)
        case ConstraintKind.SIDE_OF:
            return np.asarray(np.abs(np.sin(_off_front(spots, other))))
        case ConstraintKind.FACE_TO:
            return np.asarray((1.0 + np.cos(_off_own_front(spots, other))) / 2)
        case _:
            return np.asarray(np.cos(_off_axis(spots, other)) ** 8)


def next_to_m(size_m: Size3, other: PlaneFootprint) -> float:
    """Return the largest gap at which the engine considers two boxes next to each other."""
    mean = (sum(size_m) + sum(other.size_m) + other.high_m - other.low_m) / 6
    return min(max(NEXT_SHARE * mean, NEXT_M[0]), NEXT_M[1])


def _beside(spots: SpotCandidates, size_m: Size3, other: PlaneFootprint) -> BoolArray:
    """Mask of spots side by side with a footprint: overlapping heights, a shared span along one axis, and a small gap."""
    if other.low_m >= size_m[2] or other.high_m <= 0.0:
        return np.zeros(len(spots), dtype=bool)
    apart = np.abs(spots.center - np.asarray(other.center_m)) - spots.half - _half(other)  # (n, 2)
    across = np.abs(spots.center - np.asarray(other.center_m)) <= np.maximum(spots.half, _half(other))
    faces = (across[:, 0] & (apart[:, 1] >= 0)) | (across[:, 1] & (apart[:, 0] >= 0))
    return np.asarray(faces & (gaps(spots, other) <= NEXT_SLACK * next_to_m(size_m, other)))


def _off_front(spots: SpotCandidates, other: PlaneFootprint) -> FloatArray:
    """Angle from 0 to pi between another object's front and the direction from it to each spot."""
    way = spots.center - np.asarray(other.center_m)
    return _turn(np.arctan2(way[:, 1], way[:, 0]) - other.yaw)


def _off_own_front(spots: SpotCandidates, other: PlaneFootprint) -> FloatArray:
    """Angle from 0 to pi between the object's own front and the direction to another object's centre."""
    way = np.asarray(other.center_m) - spots.center
    return _turn(np.arctan2(way[:, 1], way[:, 0]) - spots.yaw)


def _off_axis(spots: SpotCandidates, other: PlaneFootprint) -> FloatArray:
    """Angle from 0 to pi/4 between the direction from another object to each spot and the nearest of its four axes."""
    way = spots.center - np.asarray(other.center_m)
    angle = np.arctan2(way[:, 1], way[:, 0]) - other.yaw
    quarter = math.pi / 2
    return np.asarray(np.abs((angle + quarter / 2) % quarter - quarter / 2))


def _turn(angle: FloatArray) -> FloatArray:
    return np.asarray(np.abs((angle + math.pi) % (2 * math.pi) - math.pi))


def _half(other: PlaneFootprint) -> FloatArray:
    return half_extents(np.asarray(other.yaw), other.size_m)


_COMPANIONS: Final[Mapping[str, str]] = {
    "tablefork table_knife tablespoon teaspoon chopstick dinner_napkin": "plate bowl place_mat",
    "water_glass wineglass mug teacup beer_glass": "plate bowl teapot coaster",
    "teapot jar_of_sugar carton_of_milk": "teacup mug",
    "salt_shaker": "pepper_shaker",
    "tube_of_toothpaste": "toothbrush",
    "bottle_of_shampoo bar_soap": "hand_towel sponge",
    "mouse": "keyboard laptop mousepad",
    "headset calculator notepad pencil_case stapler": "laptop keyboard notebook",
    "gaming_controller": "standing_tv",
    "bagel croissant steak pizza hamburger hotdog salmon chicken_leg": "plate chopping_board frying_pan",
    "apple pear orange peach lemon avocado banana": "bowl plate",
    "table_knife carving_knife parer": "chopping_board",
}
COMPANIONS: Final = {
    category: frozenset(others.split()) for names, others in _COMPANIONS.items() for category in names.split()
}
"""Categories that an object is placed next to on a table."""
_CENTREPIECES: Final = "vase pillar_candle snow_globe fruit_bowl candelabrum bouquet wicker_basket"
CENTREPIECES: Final = frozenset(_CENTREPIECES.split())
_BOARDS: Final = "breakfast_table dining_table coffee_table conference_table pedestal_table garden_coffee_table garden_table"
BOARDS: Final = frozenset(_BOARDS.split())
"""Tables that people stand or sit around. Their middle is for decoration."""
TABLES: Final = BOARDS | {"desk", "booth", "lab_table"}
"""Furniture that seats are placed at."""
SEATED: Final = frozenset(["plate", "bowl", "place_mat", "laptop", "notebook"])
"""Objects at the place of a seated person, at the edge of the table."""
_BACKED: Final = (
    "alarm_clock picture_frame radio table_lamp microwave toaster coffee_maker box_of_tissues hardback "
    "paperback_book folder magazine newspaper comic_book board_game jigsaw_puzzle clipboard envelope box_of_cereal "
    "box_of_crackers"
)
BACKED: Final = frozenset(_BACKED.split())
"""Objects that stand or lie at an edge, out of the way."""


def choose_constraints(brief: ConstraintBrief) -> PlacementConstraints:
    """Return the constraints of each object, the most important first. Objects that may stand anywhere have none."""
    return PlacementConstraints(
        {item.name: tuple(dict.fromkeys(_constraints_for(item, brief))) for item in brief.objects}
    )


def _constraints_for(item: ObjectBrief, brief: ConstraintBrief) -> Iterator[PlacementConstraint]:
    others = dict(brief.others)
    rank = brief.objects.index(item)
    before = {**others, **{each.name: each.category for each in brief.objects[:rank]}}
    for other in item.beside:
        yield PlacementConstraint(ConstraintKind.NEXT_TO, other, required=True)
    if brief.on_floor:
        yield from _on_floor(item, before)
        return
    alike = next((name for name, category in before.items() if category == item.category), "")
    if alike:
        yield PlacementConstraint(ConstraintKind.NEXT_TO, alike)
        yield PlacementConstraint(ConstraintKind.CENTER_ALIGNED, alike)
        return
    everyone = {**before, **{each.name: each.category for each in brief.objects[rank + 1 :]}}
    likes = COMPANIONS.get(item.category, frozenset())
    friend = next((name for name, category in everyone.items() if category in likes), "")
    if friend:
        yield PlacementConstraint(ConstraintKind.NEXT_TO, friend)
        yield PlacementConstraint(ConstraintKind.SIDE_OF, friend)
        return
    if brief.host in BOARDS and item.category in CENTREPIECES:
        yield PlacementConstraint(ConstraintKind.MIDDLE)
    elif item.category in BACKED or (brief.host in BOARDS and item.category in SEATED):
        yield PlacementConstraint(ConstraintKind.EDGE)


def _on_floor(item: ObjectBrief, before: Mapping[str, str]) -> Iterator[PlacementConstraint]:
    """Yield floor constraints: seats face a table, tables stand in the middle, other furniture at a wall."""
    role = role_of(item.category, item.size_m, 0.0) if item.kind is PlacementClass.FURNITURE else None
    table = next((name for name, category in before.items() if category in TABLES), "")
    if role is FurnitureRole.SEAT and table:
        yield PlacementConstraint(ConstraintKind.FACE_TO, table)
        yield PlacementConstraint(ConstraintKind.NEXT_TO, table)
    elif role in (FurnitureRole.LOW_TABLE, FurnitureRole.OPEN) or item.category in BOARDS:
        yield PlacementConstraint(ConstraintKind.MIDDLE)
    else:
        yield PlacementConstraint(ConstraintKind.EDGE)
