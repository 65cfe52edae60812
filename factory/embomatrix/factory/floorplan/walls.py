"""Walls of a floor plan: centre lines merged over shared edges, cut at doorways and windows, with lintels, sills and panes."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.scene import Doorway, Window

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from embomatrix.world.geometry import Vec2

WALL_M: Final = 0.12
WALL_HEIGHT_M: Final = 2.4
DOOR_LEAF_M: Final = 0.05
PANE_M: Final = 0.02

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Edge:
    """Stretch of a wall's centre line that is free for a doorway: floor on one or both sides of all of it.

    ``along`` is the axis that it runs along, ``at`` its coordinate on the other axis.
    """

    along: str
    at: float
    start: float
    end: float

    @property
    def length(self) -> float:
        return self.end - self.start

    def cut(self, rooms: tuple[str, str], start: float, width: float, height: float, model: str) -> DoorCut:
        """A doorway in this edge from ``start`` (a coordinate on the axis) over ``width`` metres."""
        middle = start + width / 2
        center = (middle, self.at) if self.along == "x" else (self.at, middle)
        doorway = Doorway(rooms, center, width, height, self.along, model)
        return DoorCut(doorway, self, (start, start + width))

    def glaze(
        self, rooms: tuple[str, str], start: float, width: float, sill: float, head: float, model: str
    ) -> WindowCut:
        """A window in this edge from ``start`` (a coordinate on the axis) over ``width`` metres."""
        middle = start + width / 2
        center = (middle, self.at) if self.along == "x" else (self.at, middle)
        return WindowCut(
            Window(rooms, center, width, sill, head, self.along, model), self, (start, start + width)
        )


@dataclass(frozen=True, slots=True)
class DoorCut:
    """A doorway and the interval that it takes out of its wall's centre line."""

    doorway: Doorway
    edge: Edge
    interval: Interval


@dataclass(frozen=True, slots=True)
class WindowCut:
    """A window and the interval that it takes out of its wall's centre line."""

    window: Window
    edge: Edge
    interval: Interval


@dataclass(frozen=True, slots=True)
class Rect:
    """A room grown by half a wall on each side."""

    x0: float
    y0: float
    x1: float
    y1: float

    def as_tuple(self) -> tuple[float, float, float, float]:
        return (self.x0, self.y0, self.x1, self.y1)

    @property
    def low(self) -> Vec2:
        return (self.x0, self.y0)

    @property
    def floor(self) -> tuple[Vec2, Vec2]:
        half = WALL_M / 2
        return (self.x0 + half, self.y0 + half), (self.x1 - half, self.y1 - half)

    def moved(self, dx: float, dy: float) -> Rect:
        return Rect(self.x0 + dx, self.y0 + dy, self.x1 + dx, self.y1 + dy)

    @property
    def edges(self) -> tuple[Edge, ...]:
        return (
            Edge("x", self.y0, self.x0, self.x1),
            Edge("x", self.y1, self.x0, self.x1),
            Edge("y", self.x0, self.y0, self.y1),
            Edge("y", self.x1, self.y0, self.y1),
        )

    def outer_edges(self, others: Iterable[Rect], clear_m: float) -> list[Edge]:
        """Stretches of this room's walls with no other room within ``clear_m`` behind them."""
        half = WALL_M / 2
        rects = list(others)
        found = []
        for number, edge in enumerate(self.edges):
            out = -1 if number in (0, 2) else 1
            taken = []
            for r in rects:
                low, high = (r.x0, r.x1) if edge.along == "x" else (r.y0, r.y1)
                near, far = (r.y0, r.y1) if edge.along == "x" else (r.x0, r.x1)
                if near < edge.at + max(0.0, clear_m * out) and far > edge.at + min(0.0, clear_m * out):
                    taken.append((low - half, high + half))
            pieces = subtract([(edge.start + half, edge.end - half)], taken)
            found += [Edge(edge.along, edge.at, a, b) for a, b in pieces]
        return found


def shared_edge(a: Rect, b: Rect) -> Edge | None:
    """The stretch of wall with floor of both rooms beside it, or None when they aren't neighbours."""
    half = WALL_M / 2
    for along, at_a, at_b, span_a, span_b in (
        ("y", (a.x0, a.x1), (b.x1, b.x0), (a.y0, a.y1), (b.y0, b.y1)),
        ("x", (a.y0, a.y1), (b.y1, b.y0), (a.x0, a.x1), (b.x0, b.x1)),
    ):
        start, end = max(span_a[0], span_b[0]) + half, min(span_a[1], span_b[1]) - half
        for mine, theirs in zip(at_a, at_b, strict=True):
            if abs(mine - theirs) < 1e-6 and end - start > 1e-6:
                return Edge(along, mine, start, end)
    return None


def build_walls(
    rects: Mapping[str, Rect], doors: Sequence[DoorCut], windows: Sequence[WindowCut] = ()
) -> tuple[ConvexPart, ...]:
    """Wall panels; lintels over the doorways and the closed leaf of every exterior door; sill, lintel and pane of windows."""
    half = WALL_M / 2
    lines: dict[tuple[str, float], list[Interval]] = defaultdict(list)
    for rect in rects.values():
        for edge in rect.edges:
            lines[edge.along, round(edge.at, 5)].append((edge.start - half, edge.end + half))
    holes: dict[tuple[str, float], list[Interval]] = defaultdict(list)
    cuts = [(door.edge, door.interval) for door in doors] + [(pane.edge, pane.interval) for pane in windows]
    for edge, interval in cuts:
        holes[edge.along, round(edge.at, 5)].append(interval)
    walls = [
        _panel(along, at, piece, 0.0, WALL_HEIGHT_M)
        for (along, at), spans in sorted(lines.items())
        for piece in subtract(_merge(spans), holes[along, at])
    ]
    for door in doors:
        height = door.doorway.height_m
        walls.append(_panel(door.edge.along, door.edge.at, door.interval, height, WALL_HEIGHT_M))
        if not door.doorway.rooms[1]:
            walls.append(_panel(door.edge.along, door.edge.at, door.interval, 0.0, height, DOOR_LEAF_M))
    for glazed in windows:
        along, at, span, window = glazed.edge.along, glazed.edge.at, glazed.interval, glazed.window
        walls += [
            _panel(along, at, span, 0.0, window.sill_m),
            _panel(along, at, span, window.head_m, WALL_HEIGHT_M),
            _panel(along, at, span, window.sill_m, window.head_m, PANE_M),
        ]
    return tuple(walls)


def _panel(
    along: str, at: float, span: Interval, low: float, high: float, thickness: float = WALL_M
) -> ConvexPart:
    middle, length = (span[0] + span[1]) / 2, span[1] - span[0]
    z = (low + high) / 2
    if along == "x":
        return ConvexPart(Shape.BOX, Pose((middle, at, z)), (length, thickness, high - low))
    return ConvexPart(Shape.BOX, Pose((at, middle, z)), (thickness, length, high - low))


def _merge(spans: Iterable[Interval]) -> list[Interval]:
    merged: list[Interval] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1] + 1e-6:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged


def subtract(spans: Iterable[Interval], holes: Iterable[Interval]) -> list[Interval]:
    """What is left of intervals when others are taken out of them."""
    pieces = list(spans)
    for low, high in holes:
        pieces = [
            part
            for start, end in pieces
            for part in ((start, min(end, low)), (max(start, high), end))
            if part[1] - part[0] > 1e-6
        ]
    return pieces
