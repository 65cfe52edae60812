"""Drawers: open boxes that slide out of the front of a carcass with their contents."""

from typing import Final

from embomatrix.factory.assets.body import Body, Walls, clamp, region, shell, spanning
from embomatrix.factory.assets.shapes import box_of, rounded
from embomatrix.world.asset import Joint, JointKind, Link
from embomatrix.world.geometry import Aabb, Vec2

TRAVEL_SHARE: Final = 0.8
"""Share of its depth by which a drawer slides out; the rest stays on the rails."""
TRAVEL_M: Final = 0.6
"""Longest travel, however deep the furniture: the inventories list a cabinet of 3 m."""
PLAY_M: Final = 0.004
"""Gap between a drawer and its carcass."""
DRAWER_M: Final = 0.21
"""Preferred height of a drawer."""
_RIM_SHARE: Final = 0.7
"""Height of a drawer's walls as a share of its room: contents may stick out a little."""


def add_drawers(body: Body, bay: Aabb, front: Aabb, prefix: str = "", most: int = 4) -> None:
    """Fill a bay with drawers of equal height, named from the top down.

    ``bay`` is the space within the carcass, open at its +x side; ``front`` is the box that the panels fill before it.
    """
    height = front.size_m[2]
    count = int(clamp(round(height / DRAWER_M), 1, most))
    # Panels share the front, boxes share the bay: a panel also covers the edges of the carcass.
    fronts = _divided((front.low_m[2], front.high_m[2]), count)
    for number, (low, high) in enumerate(fronts, start=1):
        room = (max(low, bay.low_m[2]), min(high, bay.high_m[2]))
        panel = spanning(front, 2, (low + PLAY_M / 4, high - PLAY_M / 4))
        name = f"{prefix}drawer{number}" if count > 1 else f"{prefix}drawer"
        behind = spanning(bay, 0, (bay.low_m[0], panel.low_m[0]))
        _add_drawer(body, name, panel, spanning(behind, 2, room))


def _add_drawer(body: Body, name: str, panel: Aabb, room: Aabb) -> None:
    """Add one drawer: a panel with a box behind it."""
    (x0, y0, z0), (x1, y1, z1) = room.low_m, room.high_m
    low, top = z0 + PLAY_M, z1 - PLAY_M
    wall = clamp(0.02 * (y1 - y0), 0.004, 0.012)
    outer = region((x0 + PLAY_M, x1), (y0 + PLAY_M, y1 - PLAY_M), (low, low + _RIM_SHARE * (top - low)))
    boards, cavity = shell(outer, Walls(wall, 0.0, wall, wall, wall, 0.0))
    joint = Joint(
        JointKind.PRISMATIC,
        rounded(*panel.center_m),
        (1.0, 0.0, 0.0),
        round(min(TRAVEL_SHARE * (panel.high_m[0] - outer.low_m[0]), TRAVEL_M), 6),
    )
    body.moving.append(Link(name, (box_of(panel), *boards), joint))
    body.add_interior(name, spanning(cavity, 2, (cavity.low_m[2], top)), (name,), link=name)


def _divided(span: Vec2, count: int) -> list[Vec2]:
    """Return equal intervals from the top down."""
    low, high = span
    pitch = (high - low) / count
    return [(high - (k + 1) * pitch, high - k * pitch) for k in range(count)]
