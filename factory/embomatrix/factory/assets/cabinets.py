"""Assets with a cavity: cabinets, fridges, ovens, open shelving, chests with a lid, open boxes."""

import itertools
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from embomatrix.factory.assets.body import (
    FIT_M,
    OPEN_ABOVE_M,
    Body,
    Hinge,
    Walls,
    centred,
    clamp,
    hinged,
    region,
    shell,
    spanning,
)
from embomatrix.factory.assets.drawers import add_drawers
from embomatrix.factory.assets.furniture import slab
from embomatrix.factory.assets.shapes import box, box_of
from embomatrix.world.geometry import Aabb, ConvexPart, Vec2, Vec3

MAX_PARTS: Final = 16
"""Upper limit for the parts of a link: Bullet silently drops further ones."""
_BOARD_M: Final = 0.012
"""Thickness of the board below drawers."""


class FrontKind(StrEnum):
    """Closure of a cabinet's front."""

    OPEN = "open"
    SIDE_HINGED = "side_hinged"
    DROP_DOWN = "drop_down"


@dataclass(frozen=True, slots=True)
class CabinetStyle:
    """Proportions of a family of cabinets, in metres.

    ``tier_m`` is the preferred height of a shelf compartment and ``bay_m`` the greatest width of a pair of doors.
    ``plinth_m`` lifts the door off the floor, ``head_m`` is a strip above the door. ``panel_share`` is the share of the width
    for a control panel at the left, ``drawer_share`` the share of the height for drawers at the top.
    """

    front: FrontKind
    wall_m: float
    tier_m: float
    plinth_m: float = 0.0
    head_m: float = 0.0
    panel_share: float = 0.0
    bay_m: float = 1.1
    single_door_m: float = 0.62
    drawer_share: float = 0.0
    boards: bool = False
    """Compartments are boards to stand objects on, as in a bookcase, and no cavities."""


CUPBOARD: Final = CabinetStyle(FrontKind.SIDE_HINGED, wall_m=0.018, tier_m=0.34, plinth_m=0.06)
DRAWER_CUPBOARD: Final = replace(CUPBOARD, drawer_share=0.26)
CHEST_OF_DRAWERS: Final = replace(CUPBOARD, drawer_share=1.0)
WALL_CUPBOARD: Final = CabinetStyle(FrontKind.SIDE_HINGED, wall_m=0.018, tier_m=0.36)
LOCKER: Final = CabinetStyle(FrontKind.SIDE_HINGED, wall_m=0.018, tier_m=0.9, plinth_m=0.04, bay_m=0.5)
FRIDGE: Final = CabinetStyle(
    FrontKind.SIDE_HINGED, wall_m=0.045, tier_m=0.38, plinth_m=0.08, single_door_m=0.85
)
MICROWAVE: Final = CabinetStyle(
    FrontKind.SIDE_HINGED, wall_m=0.018, tier_m=1.0, panel_share=0.2, single_door_m=9.0, bay_m=9.0
)
WASHER: Final = CabinetStyle(
    FrontKind.SIDE_HINGED, wall_m=0.045, tier_m=2.0, plinth_m=0.1, head_m=0.12, single_door_m=9.0, bay_m=9.0
)
FREEZER: Final = CabinetStyle(FrontKind.OPEN, wall_m=0.045, tier_m=0.4, plinth_m=0.08)
"""No door: BEHAVIOR-1K does not list these categories as openable, yet its tasks keep objects inside them."""
OVEN: Final = CabinetStyle(FrontKind.DROP_DOWN, wall_m=0.03, tier_m=0.3, plinth_m=0.05, head_m=0.07)
DISHWASHER: Final = CabinetStyle(FrontKind.DROP_DOWN, wall_m=0.03, tier_m=0.28, plinth_m=0.08, head_m=0.05)
SHELVING: Final = CabinetStyle(
    FrontKind.OPEN, wall_m=0.02, tier_m=0.32, plinth_m=0.05, bay_m=1.3, boards=True
)
CUBBY: Final = CabinetStyle(FrontKind.OPEN, wall_m=0.018, tier_m=0.35, plinth_m=0.06, bay_m=1.3)
DRAWER_CUBBY: Final = replace(CUBBY, drawer_share=0.34)
WARDROBE: Final = CabinetStyle(FrontKind.OPEN, wall_m=0.022, tier_m=1.1, plinth_m=0.06, bay_m=1.3)


def cabinet(size_m: Vec3, style: CabinetStyle) -> Body:
    """A box with shelves, in bays with one or two doors, perhaps with drawers above them; its top is a surface too."""
    body = Body()
    outer = centred(size_m)
    wall = min(style.wall_m, 0.08 * min(size_m))
    plain = style.front is FrontKind.OPEN and not style.drawer_share
    door_m = 0.0 if plain else clamp(0.06 * size_m[0], min(0.006, wall), min(0.02, wall))
    frame = Aabb(outer.low_m, (outer.high_m[0] - door_m, *outer.high_m[1:]))
    walls = _walls(size_m, style, wall)
    body.parts, cavity = shell(frame, walls)
    if style.panel_share:
        low = (frame.high_m[0], outer.high_m[1] - walls.left, outer.low_m[2])
        body.parts.append(box(low, outer.high_m))
    spans = _bays(cavity, style, max(wall, 2 * door_m))
    for (_, before), (after, _) in itertools.pairwise(spans):
        body.parts.append(box_of(spanning(cavity, 1, (before, after))))
    opening = region(
        (outer.high_m[0] - door_m, outer.high_m[0]),
        (outer.low_m[1], outer.high_m[1] - (walls.left if style.panel_share else 0.0)),
        (outer.low_m[2] + _plinth(size_m, style), outer.high_m[2] - _head(size_m, style)),
    )
    edges = [opening.low_m[1], *((a[1] + b[0]) / 2 for a, b in itertools.pairwise(spans)), opening.high_m[1]]
    boards = (MAX_PARTS - len(body.parts)) // len(spans)
    for number, (span, reach) in enumerate(zip(spans, itertools.pairwise(edges), strict=True), start=1):
        prefix = f"bay{number}_" if len(spans) > 1 else ""
        _fill(body, style, spanning(cavity, 1, span), spanning(opening, 1, reach), boards, prefix)
    return body.add_support("top", frame.low_m[:2], frame.high_m[:2], frame.high_m[2])


def _fill(body: Body, style: CabinetStyle, bay: Aabb, front: Aabb, boards: int, prefix: str) -> None:
    """Add drawers at the top of a bay and shelves behind doors below them, with at most ``boards`` boards."""
    if style.drawer_share:
        gap = min(FIT_M, 0.2 * front.size_m[0])
        panels = Aabb((front.low_m[0] + gap, *front.low_m[1:]), front.high_m)
        if style.drawer_share == 1.0:
            add_drawers(body, bay, panels, prefix, most=2 if prefix else 4)
            return
        z = bay.high_m[2] - style.drawer_share * bay.size_m[2]
        body.parts.append(box_of(spanning(bay, 2, (z - _BOARD_M, z))))
        upper = spanning(panels, 2, (z, panels.high_m[2]))
        add_drawers(body, spanning(bay, 2, (z, bay.high_m[2])), upper, prefix)
        bay = spanning(bay, 2, (bay.low_m[2], z - _BOARD_M))
        front = spanning(front, 2, (front.low_m[2], z))
        boards -= 1
    doors = _doors(body, style, front, prefix)
    _add_tiers(body, bay, style, boards, prefix, doors)


def shelving(size_m: Vec3) -> Body:
    """Open shelves; a low model is a single board for a wall."""
    if size_m[2] < 0.2:
        return slab(size_m)
    return cabinet(size_m, SHELVING)


def _plinth(size_m: Vec3, style: CabinetStyle) -> float:
    return min(style.plinth_m, 0.1 * size_m[2])


def _head(size_m: Vec3, style: CabinetStyle) -> float:
    return min(style.head_m, 0.12 * size_m[2])


def _walls(size_m: Vec3, style: CabinetStyle, wall: float) -> Walls:
    return Walls(
        back=wall,
        front=0.0,
        right=wall,
        left=max(wall, style.panel_share * size_m[1]),
        bottom=wall + _plinth(size_m, style),
        top=wall + _head(size_m, style),
    )


def _bays(cavity: Aabb, style: CabinetStyle, divider_m: float) -> list[Vec2]:
    """Return the intervals along y between the dividers; a divider covers the edges of two doors."""
    low, high = cavity.low_m[1], cavity.high_m[1]
    count = int(clamp(round((high - low) / style.bay_m), 1, 4))
    width = (high - low - (count - 1) * divider_m) / count
    return [(low + k * (width + divider_m), low + k * (width + divider_m) + width) for k in range(count)]


def _doors(body: Body, style: CabinetStyle, front: Aabb, prefix: str) -> tuple[str, ...]:
    """Add the doors of one bay and return their names."""
    if style.front is FrontKind.OPEN:
        return ()
    (x0, y0, _), (x1, y1, _) = front.low_m, front.high_m
    gap = min(FIT_M, 0.2 * (x1 - x0))
    panel = spanning(front, 0, (x0 + gap, x1))
    if style.front is FrontKind.DROP_DOWN:
        doors = [hinged(f"{prefix}door", panel, Hinge.BOTTOM)]
    elif y1 - y0 <= style.single_door_m:
        doors = [hinged(f"{prefix}door", panel, Hinge.RIGHT)]
    else:
        middle = (y0 + y1) / 2
        doors = [
            hinged(f"{prefix}right_door", spanning(panel, 1, (y0, middle - gap / 2)), Hinge.RIGHT),
            hinged(f"{prefix}left_door", spanning(panel, 1, (middle + gap / 2, y1)), Hinge.LEFT),
        ]
    body.moving.extend(doors)
    return tuple(door.name for door in doors)


def _add_tiers(
    body: Body, bay: Aabb, style: CabinetStyle, boards: int, prefix: str, doors: tuple[str, ...]
) -> None:
    """Divide a bay into compartments of equal height, with at most ``boards`` shelf boards."""
    (x0, y0, z0), (x1, y1, z1) = bay.low_m, bay.high_m
    count = int(clamp(round((z1 - z0) / style.tier_m), 1, boards + 1))
    board = clamp(0.02 * (z1 - z0), 0.006, 0.016)
    height = (z1 - z0 - (count - 1) * board) / count
    for tier in range(count):
        floor = z0 + tier * (height + board)
        name = f"{prefix}shelf{tier + 1}" if count > 1 else f"{prefix}inside"
        tier_bay = spanning(bay, 2, (floor, floor + height))
        if style.boards:
            body.add_board(name, tier_bay)
        else:
            body.add_interior(name, tier_bay, doors)
        if tier:
            body.parts.append(box((x0, y0, floor - board), (x1 - FIT_M, y1, floor)))


def chest(size_m: Vec3, lid_share: float = 0.12) -> Body:
    """A box with a lid that is hinged at the back and opens by a quarter turn."""
    outer = centred(size_m)
    wall = clamp(0.05 * min(size_m[:2]), 0.003, 0.025)
    lid = min(wall, lid_share * size_m[2])
    z1 = outer.high_m[2] - lid
    carcass = spanning(outer, 2, (outer.low_m[2], z1))
    parts, cavity = shell(carcass, Walls(wall, wall, wall, wall, min(wall, 0.1 * size_m[2]), 0.0))
    panel = spanning(outer, 2, (z1 + min(FIT_M, 0.2 * lid), outer.high_m[2]))
    return Body(parts, [hinged("lid", panel, Hinge.BACK)]).add_interior("inside", cavity, ("lid",))


SHALLOW_M: Final = 0.025
"""Depth from which an open vessel has a cavity; a shallower tray has only a surface."""


def open_box(size_m: Vec3) -> Body:
    """A box without a lid: baskets, crates, bins, tubs."""
    parts, cavity = _open_shell(size_m)
    if cavity.size_m[2] >= SHALLOW_M:
        return Body(parts).add_interior("inside", cavity, clearance_m=OPEN_ABOVE_M)
    return Body(parts).add_support("floor", cavity.low_m[:2], cavity.high_m[:2], cavity.low_m[2])


def tray(size_m: Vec3) -> Body:
    """A board with a rim: objects stand on it, however high the rim is."""
    parts, cavity = _open_shell(size_m)
    return Body(parts).add_board(
        "tray", spanning(cavity, 2, (cavity.low_m[2], cavity.low_m[2] + OPEN_ABOVE_M))
    )


def _open_shell(size_m: Vec3) -> tuple[list[ConvexPart], Aabb]:
    """Return floor and walls of a box without a lid, and its cavity."""
    wall = clamp(0.04 * min(size_m[:2]), 0.003, 0.05)
    floor = clamp(0.06 * size_m[2], 0.002, 0.04)
    return shell(centred(size_m), Walls(wall, wall, wall, wall, floor, 0.0))
