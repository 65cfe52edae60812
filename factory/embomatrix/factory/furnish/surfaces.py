"""Placement of small objects: free places on the surfaces and in the cavities of placed furniture."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.furnish.hosts import NO_HOSTS, hosts_of, kept_behind_doors
from embomatrix.factory.furnish.pieces import REST_GAP_M, FurniturePiece, Placed
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.space import BoxStack
from embomatrix.world.state import Relation

FloatArray = NDArray[np.float64]

_EDGE_M: Final = 0.01
_SAMPLES: Final = 60
_SPACING_M: Final = np.array([0.01, 0.01, 0.0])
"""Free space to other objects along each axis."""
_HIGHEST_M: Final = 1.75
_TALL_M: Final = 1.3
"""Cabinets higher than this hold objects on their boards, not on their top."""
_HEAD_SHARE: Final = 0.3
"""Share of a bed's free length, at its head, on which pillows lie."""
_NO_SURFACES: Final = (
    FurnitureRole.RUG,
    FurnitureRole.CEILING,
    FurnitureRole.SURFACE,
    FurnitureRole.STRUCTURE,
)
"""Roles of pieces that hold no small objects."""
_SAME_KIND: Final = 2.0
"""Ranks by which a surface is preferred if it already holds an object of the same category."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Axis-aligned support surface in the world.

    ``host`` is the index of its piece. ``walled`` means in a compartment, ``shut`` behind a door.
    """

    host: int
    name: str
    interior: str
    walled: bool
    x0: float
    y0: float
    x1: float
    y1: float
    z: float
    clearance_m: float
    shut: bool


def surfaces_of(placed: Placed, number: int) -> list[Surface]:
    """Return the support surfaces of a piece placed at a quarter turn."""
    found = []
    turned = abs(math.sin(placed.yaw)) > 0.5
    asset = placed.piece.asset
    doored = {interior.name for interior in asset.interiors if interior.closed_by}
    for support in asset.supports:
        cx, cy, cz = placed.pose.apply(support.center_m)
        sx, sy = support.size_m[::-1] if turned else support.size_m
        edges = (cx - sx / 2, cy - sy / 2, cx + sx / 2, cy + sy / 2)
        inner, walled, shut = support.interior, support.walled, support.interior in doored
        found.append(Surface(number, support.name, inner, walled, *edges, cz, support.clearance_m, shut))
    return found


class SurfacePlacer:
    """Places small objects on surfaces, at least 1 cm apart."""

    def __init__(self, placed: list[Placed], rng: np.random.Generator) -> None:
        self.placed = placed
        self._rng = rng
        self._surfaces: dict[str, list[Surface]] = defaultdict(list)
        for number, item in enumerate(placed):
            self._surfaces[item.room] += self._usable(item, number)
        self._boxes = BoxStack(p.box for p in placed)
        self._used = Counter(p.host for p in placed)
        self._holds: set[tuple[str, int, str]] = set()

    def place(self, piece: FurniturePiece, rooms: Sequence[str]) -> bool:
        """Place the piece on the best free surface of the first room that has one; False if none has."""
        for room in rooms:
            for surface in self._ranked(piece, room):
                if self._set_on(piece, surface):
                    return True
        return False

    def _usable(self, placed: Placed, number: int) -> Iterable[Surface]:
        piece = placed.piece
        flat = not piece.upended and abs(math.sin(2 * placed.yaw)) < 1e-6
        on_wall = piece.role is FurnitureRole.WALL
        if not flat or piece.role in _NO_SURFACES or (on_wall and piece.category != "shelf"):
            return []
        tall = placed.bottom + piece.size_m[2] > _TALL_M and not on_wall
        return [
            s
            for s in surfaces_of(placed, number)
            if 0.05 < s.z < _HIGHEST_M and not (tall and s.z > _TALL_M and not s.walled)
        ]

    def _ranked(self, piece: FurniturePiece, room: str) -> list[Surface]:
        """Return the surfaces of a room in order of preference: listed hosts first, then any other open surface."""
        wanted = {host: rank for rank, host in enumerate(hosts_of(piece.category))}
        surfaces = self._surfaces[room]
        noise = self._rng.uniform(0.0, 0.8, len(surfaces))
        ranked = []
        for surface, extra in zip(surfaces, noise, strict=True):
            category = self.placed[surface.host].piece.category
            if surface.shut and not kept_behind_doors(piece.category, category):
                continue
            rank = wanted.get(category)
            if rank is None:
                if category in NO_HOSTS or surface.walled:
                    continue
                rank = len(wanted) + 3
            together = (piece.category, surface.host, surface.name) in self._holds
            cost = rank + min(0.35 * self._used[surface.host], 4.0) + float(extra) - _SAME_KIND * together
            ranked.append((cost, surface))
        return [s for _, s in sorted(ranked, key=lambda item: item[0])]

    def _set_on(self, piece: FurniturePiece, surface: Surface) -> bool:
        """Sample places on the surface and use the first free one; False if none is free."""
        if piece.size_m[2] + 0.01 > surface.clearance_m:
            return False
        host = self.placed[surface.host]
        # Screens and machines get their host's heading; loose objects get a random one.
        square = max(piece.size_m[:2]) > 0.3 or bool(hosts_of(piece.category) and piece.asset.joints)
        turn = np.zeros(_SAMPLES) if square else self._rng.uniform(-0.6, 0.6, _SAMPLES)
        x, y, half, fits = self._spots(piece, surface, host, host.yaw + turn)
        bottom = surface.z + REST_GAP_M
        low = np.column_stack([x - half[:, 0], y - half[:, 1], np.full(_SAMPLES, bottom)])
        high = np.column_stack([x + half[:, 0], y + half[:, 1], np.full(_SAMPLES, bottom + piece.size_m[2])])
        free = np.flatnonzero(fits & ~self._hits(low, high, surface.host))
        if not len(free):
            return False
        pick = int(free[0])
        relation = Relation.INSIDE if surface.interior else Relation.ONTOP
        yaw = host.yaw + float(turn[pick])
        x_m, y_m = float(x[pick]), float(y[pick])
        item = Placed(piece, host.room, x_m, y_m, bottom, yaw, surface.host, relation)
        self.placed.append(item)
        self._boxes.extend([item.box])
        self._used[item.host] += 1
        self._holds.add((piece.category, surface.host, surface.name))
        return True

    def _spots(
        self, piece: FurniturePiece, surface: Surface, host: Placed, yaw: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return random centres on the surface, the half extents there (n, 2), and a mask of those within its edges."""
        overhang = 0.2 if piece.category == "standing_tv" else 0.0
        depth, width, _ = piece.size_m
        cos, sin = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
        half = np.column_stack([depth * cos + width * sin, depth * sin + width * cos]) / 2
        room = np.array([surface.x1 - surface.x0, surface.y1 - surface.y0])
        slack = room - 2 * half * (1 - 2 * overhang) - 2 * _EDGE_M  # (n, 2)
        middle = np.array([surface.x0 + surface.x1, surface.y0 + surface.y1]) / 2
        shares = self._rng.uniform(-0.5, 0.5, (len(yaw), 2))
        if (piece.category, host.piece.category) == ("pillow", "bed"):
            _to_head(shares, host.yaw)
        spots = middle + shares * slack
        return spots[:, 0], spots[:, 1], half, np.asarray(slack.min(axis=1) >= 0)

    def _hits(self, low: FloatArray, high: FloatArray, host: int) -> NDArray[np.bool_]:
        """Mark the boxes, given by corners of shape (n, 3), that meet anything but their host and its supports."""
        boxes = self._boxes.rows
        near = ~np.any(
            (boxes[:, 3:] <= low.min(axis=0) - _SPACING_M) | (boxes[:, :3] >= high.max(axis=0) + _SPACING_M),
            axis=1,
        )
        while host >= 0:
            near[host] = False
            host = self.placed[host].host
        others = boxes[near]  # (m, 6)
        apart = (others[None, :, 3:] <= low[:, None] - _SPACING_M) | (
            others[None, :, :3] >= high[:, None] + _SPACING_M
        )
        return np.asarray(np.any(~np.any(apart, axis=2), axis=1))


def _to_head(shares: FloatArray, yaw: float) -> None:
    """Move the first half of the places on a bed to its head. shares: (n, 2) of its free length and width."""
    axis = int(abs(math.sin(yaw)) > 0.5)
    back = -math.copysign(0.5, (math.cos(yaw), math.sin(yaw))[axis])
    shares[: len(shares) // 2, axis] = back + _HEAD_SHARE * (shares[: len(shares) // 2, axis] - back)
