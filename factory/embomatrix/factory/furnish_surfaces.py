"""Small things: free places on the surfaces and in the cavities of furniture that stands already."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish_pieces import REST_GAP_M
from embomatrix.factory.furnish_roles import SURFACE_HOSTS, Role
from embomatrix.factory.furnish_solver import Placed
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from embomatrix.factory.furnish_pieces import Piece

TOP_ROOM_M: Final = 1.0
"""Clearance at least assumed over a surface in the open; what stands above it is tested as a solid."""
_EDGE_M: Final = 0.01
_SAMPLES: Final = 60
_SPACING_M: Final = np.array([0.01, 0.01, 0.0])
"""Free space to other things along each axis."""
_NO_HOSTS: Final = frozenset(
    {
        *(
            "toilet",
            "taboret",
            "straight_chair",
            "swivel_chair",
            "bench",
            "ottoman",
            "bathtub",
            "urinal",
            "fridge",
        ),
        *(
            "furniture_sink",
            "pedestal_sink",
            "commercial_kitchen_sink",
            "public_trash_can",
            "trash_can",
            "floor_lamp",
        ),
        *(
            "bed",
            "sofa",
            "armchair",
            "stove",
            "flat_top_grill",
            "deep_fryer",
            "jukebox",
            "shower_stall",
            "oven",
        ),
    }
)
"""Nothing is put down on these unless SURFACE_HOSTS names them."""
_HIGHEST_M: Final = 1.7


@dataclass(frozen=True, slots=True)
class Surface:
    """A support surface in the world: axis-aligned, ``host`` is the number of the piece that owns it."""

    host: int
    name: str
    interior: str
    x0: float
    y0: float
    x1: float
    y1: float
    z: float
    clearance_m: float


def surfaces_of(placed: Placed, number: int) -> list[Surface]:
    """The support surfaces of a placed piece at a quarter turn."""
    found = []
    turned = abs(math.sin(placed.yaw)) > 0.5
    for support in placed.piece.asset.supports:
        cx, cy, cz = placed.pose.apply(support.center_m)
        sx, sy = support.size_m[::-1] if turned else support.size_m
        found.append(
            Surface(
                number,
                support.name,
                support.interior,
                cx - sx / 2,
                cy - sy / 2,
                cx + sx / 2,
                cy + sy / 2,
                cz,
                support.clearance_m,
            )
        )
    return found


class SurfacePlacer:
    """Sets small things on surfaces, none closer than a centimetre to another."""

    def __init__(self, placed: list[Placed], rng: np.random.Generator) -> None:
        self.placed = placed
        self._rng = rng
        self._surfaces = [s for i, p in enumerate(placed) for s in self._usable(p, i)]
        self._boxes = [p.box for p in placed]

    def place(self, piece: Piece, rooms: Sequence[str]) -> bool:
        """Set the piece on the best surface with room, in the first of the rooms that has one. False when none has."""
        for room in rooms:
            for surface in self._ranked(piece, room):
                if self._set_on(piece, surface):
                    return True
        return False

    def _usable(self, placed: Placed, number: int) -> Iterable[Surface]:
        flat = not placed.piece.upended and abs(math.sin(2 * placed.yaw)) < 1e-6
        if placed.piece.role in (Role.RUG, Role.CEILING, Role.SURFACE, Role.STRUCTURE) or not flat:
            return []
        if placed.piece.role is Role.WALL and placed.piece.category != "shelf":
            return []
        return [s for s in surfaces_of(placed, number) if 0.05 < s.z < _HIGHEST_M]

    def _ranked(self, piece: Piece, room: str) -> list[Surface]:
        """Surfaces of the room in the order of preference: the listed hosts, then any other in the open."""
        wanted = SURFACE_HOSTS.get(piece.category, ())
        ranked = []
        for surface in self._surfaces:
            host = self.placed[surface.host]
            if host.room != room:
                continue
            category = host.piece.category
            if category in wanted:
                rank = wanted.index(category)
            elif category in _NO_HOSTS or surface.interior:
                continue
            else:
                rank = len(wanted) + 3
            used = sum(1 for p in self.placed if p.host == surface.host)
            ranked.append((rank + 0.35 * used + self._rng.uniform(0.0, 0.8), surface))
        return [s for _, s in sorted(ranked, key=lambda item: item[0])]

    def _set_on(self, piece: Piece, surface: Surface) -> bool:
        height = piece.size_m[2]
        if surface.interior and height + 0.01 > surface.clearance_m:
            return False
        host = self.placed[surface.host]
        overhang = 0.2 if piece.category == "standing_tv" else 0.0
        # Screens and machines look where their host looks; loose things lie as they were put down.
        square = max(piece.size_m[:2]) > 0.3 or (piece.category in SURFACE_HOSTS and piece.asset.joints)
        for _ in range(_SAMPLES):
            yaw = host.yaw if square else host.yaw + float(self._rng.uniform(-0.6, 0.6))
            trial = Placed(
                piece, host.room, 0.0, 0.0, surface.z + REST_GAP_M, yaw, surface.host,
                Relation.INSIDE if surface.interior else Relation.ONTOP, surface.interior,
            )  # fmt: skip
            spot = self._spot(trial, surface, overhang)
            if spot is None:
                return False
            item = replace(trial, x=spot[0], y=spot[1])
            if not self._hits(item):
                self.placed.append(item)
                self._boxes.append(item.box)
                return True
        return False

    def _spot(self, trial: Placed, surface: Surface, overhang: float) -> tuple[float, float] | None:
        x0, y0, _, x1, y1, _ = trial.box  # around the origin
        slack_x = surface.x1 - surface.x0 - (x1 - x0) * (1 - 2 * overhang) - 2 * _EDGE_M
        slack_y = surface.y1 - surface.y0 - (y1 - y0) * (1 - 2 * overhang) - 2 * _EDGE_M
        if min(slack_x, slack_y) < 0:
            return None
        cx, cy = (surface.x0 + surface.x1) / 2, (surface.y0 + surface.y1) / 2
        dx, dy = self._rng.uniform(-0.5, 0.5, 2)
        return (float(cx + dx * slack_x), float(cy + dy * slack_y))

    def _hits(self, item: Placed) -> bool:
        boxes = np.asarray(self._boxes)
        mine = np.asarray(item.box)
        apart = (boxes[:, 3:] <= mine[:3] - _SPACING_M) | (boxes[:, :3] >= mine[3:] + _SPACING_M)
        meets = ~np.any(apart, axis=1)
        host = item.host
        while host >= 0:
            meets[host] = False
            host = self.placed[host].host
        return bool(np.any(meets))
