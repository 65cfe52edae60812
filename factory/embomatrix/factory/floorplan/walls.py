"""Walls of a floor plan: centre lines merged over shared edges, cut at doorways and windows, with lintels, sills and panes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Generic, NamedTuple, TypeVar

from embomatrix.world.geometry import ConvexPart, Pose, Shape, Vec2
from embomatrix.world.scene import ROOM_HEIGHT_M, Doorway, Window

WALL_M: Final = 0.12
DOOR_LEAF_M: Final = 0.05
PANE_M: Final = 0.02

Interval = tuple[float, float]
OpeningT = TypeVar("OpeningT", Doorway, Window)


@dataclass(frozen=True, slots=True)
class Edge:
    """Stretch of a wall's centre line in which a doorway or window can be cut.

    It runs along the axis ``along``, at the coordinate ``at`` of the other axis.
    """

    along: str
    at: float
    start: float
    end: float

    @property
    def length(self) -> float:
        return self.end - self.start

    def point(self, at: float) -> Vec2:
        """Return the point of the centre line with this coordinate along the axis."""
        return (at, self.at) if self.along == "x" else (self.at, at)

    def doorway(
        self, rooms: tuple[str, str], start: float, width: float, height: float, model: str
    ) -> WallCut[Doorway]:
        """Cut a doorway that begins at the coordinate ``start``."""
        center = self.point(start + width / 2)
        return WallCut(Doorway(rooms, center, width, height, self.along, model), self, (start, start + width))


@dataclass(frozen=True, slots=True)
class WallCut(Generic[OpeningT]):
    """Doorway or window, and the interval that it takes out of its wall's centre line."""

    opening: OpeningT
    edge: Edge
    interval: Interval


class Rect(NamedTuple):
    """Floor of a room grown by half a wall on each side."""

    x0: float
    y0: float
    x1: float
    y1: float

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
        """Return the stretches of this room's walls with no other room within ``clear_m`` behind them."""
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
    """Return the stretch of wall with floor of both rooms beside it; None if they are no neighbours."""
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


class WallHeights:
    """Heights of the walls along each line: that of the higher room where two rooms share a wall."""

    def __init__(self, rects: Mapping[str, Rect], heights_m: Mapping[str, float]) -> None:
        """Collect the edges of the rooms; a room without a height in ``heights_m`` has the usual one."""
        half = WALL_M / 2
        self.lines: dict[tuple[str, float], list[tuple[float, Interval]]] = defaultdict(list)
        for name, rect in rects.items():
            for edge in rect.edges:
                span = (edge.start - half, edge.end + half)
                self.lines[edge.along, round(edge.at, 5)].append((heights_m.get(name, ROOM_HEIGHT_M), span))

    def spans(self, along: str, at: float) -> Iterator[tuple[float, Interval]]:
        """Yield disjoint stretches of a line with their heights, the highest first."""
        found = self.lines[along, at]
        higher: list[Interval] = []
        for height in sorted({height for height, _ in found}, reverse=True):
            merged = _merge(span for each, span in found if each == height)
            yield from ((height, piece) for piece in subtract(merged, higher))
            higher += merged

    def of(self, edge: Edge, span: Interval) -> float:
        """Return the height of the wall over an opening."""
        found = self.lines[edge.along, round(edge.at, 5)]
        return max(height for height, (start, end) in found if start < span[1] and end > span[0])


def build_walls(
    rects: Mapping[str, Rect],
    doors: Sequence[WallCut[Doorway]],
    windows: Sequence[WallCut[Window]] = (),
    heights_m: Mapping[str, float] = MappingProxyType({}),
) -> tuple[ConvexPart, ...]:
    """Return wall panels, lintels of doorways, the closed panel of the exterior door, and sills, lintels and panes."""
    heights = WallHeights(rects, heights_m)
    holes: dict[tuple[str, float], list[Interval]] = defaultdict(list)
    cuts = [(door.edge, door.interval) for door in doors] + [(pane.edge, pane.interval) for pane in windows]
    for edge, interval in cuts:
        holes[edge.along, round(edge.at, 5)].append(interval)
    walls = [
        _panel(along, at, piece, 0.0, height_m)
        for along, at in sorted(heights.lines)
        for height_m, span in heights.spans(along, at)
        for piece in subtract([span], holes[along, at])
    ]
    for door in doors:
        height = door.opening.height_m
        top = heights.of(door.edge, door.interval)
        walls.append(_panel(door.edge.along, door.edge.at, door.interval, height, top))
        if not door.opening.rooms[1]:
            walls.append(_panel(door.edge.along, door.edge.at, door.interval, 0.0, height, DOOR_LEAF_M))
    for glazed in windows:
        along, at, span, window = glazed.edge.along, glazed.edge.at, glazed.interval, glazed.opening
        walls += [
            _panel(along, at, span, 0.0, window.sill_m),
            _panel(along, at, span, window.head_m, heights.of(glazed.edge, span)),
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
    """Return the parts of intervals outside all holes."""
    pieces = list(spans)
    for low, high in holes:
        pieces = [
            part
            for start, end in pieces
            for part in ((start, min(end, low)), (max(start, high), end))
            if part[1] - part[0] > 1e-6
        ]
    return pieces
