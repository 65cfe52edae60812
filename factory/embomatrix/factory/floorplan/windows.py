"""Windows of a floor plan, set into the outer walls of their rooms between the doorways and spread over each wall."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from embomatrix.factory.floorplan.spec import OUTDOORS, OpeningSpec, RoomSpec
from embomatrix.factory.floorplan.walls import Edge, Rect, WallCut, shared_edge, subtract
from embomatrix.world.scene import Doorway, Window

SILL_M: Final = 0.9
HEAD_M: Final = 2.15
"""Upper edge of windows; the lintel above carries the wall."""
LEAST_SILL_M: Final = 0.1
TRANSOM_M: Final = 0.6
"""Windows less high than this sit right under the lintel."""
LEAST_SHARE: Final = 0.5
LEAST_WIDTH_M: Final = 2.0
"""A window is narrowed to fit its wall, but not below half its width or 2 m, whichever is less."""
GAP_M: Final = 0.25
"""Width of the wall between two windows, and between a window and a doorway or corner."""
VIEW_M: Final = 0.8
"""Depth of free space behind a window."""
SKYLIGHT_M: Final = 6.0
"""Higher windows belong to a roof or facade."""


@dataclass(slots=True)
class _Stretch:
    """Stretch of outer wall, the name of the garden ``beyond`` it, and the windows assigned to it."""

    edge: Edge
    beyond: str
    windows: list[OpeningSpec] = field(default_factory=list)

    @property
    def free_m(self) -> float:
        """Greatest width of one more window."""
        return self.edge.length - sum(w.width_m + GAP_M for w in self.windows) - 2 * GAP_M


def place_windows(
    rooms: Sequence[RoomSpec], rects: Mapping[str, Rect], doors: Sequence[WallCut[Doorway]]
) -> tuple[list[WallCut[Window]], list[str]]:
    """Return the windows of all rooms, and a sentence on windows without a wall.

    A window goes into the longest free stretch of its room's outer walls and is narrowed to fit. A garden counts as outside:
    the windows that a garden lists are those of the rooms around it.
    """
    outdoors = {r.name for r in rooms if r.type in OUTDOORS}
    cuts: list[WallCut[Window]] = []
    left_out: list[str] = []
    for room in rooms:
        if room.name in outdoors:
            if room.windows:
                left_out.append(
                    f"{len(room.windows)} windows in {room.name}: they belong to the rooms of the house, which list them too"
                )
            continue
        stretches = _stretches(room, rects, doors, outdoors)
        dropped: Counter[str] = Counter()
        for window in sorted(room.windows, key=lambda w: -w.width_m):
            if window.height_m > SKYLIGHT_M or not _assign(window, stretches):
                dropped[window.model] += 1
        cuts += [cut for stretch in stretches for cut in _spread(stretch, room.name)]
        left_out += [
            f"{n} window-{model} in {room.name}: no outer wall has room for it"
            for model, n in dropped.items()
        ]
    return cuts, left_out


def _stretches(
    room: RoomSpec, rects: Mapping[str, Rect], doors: Sequence[WallCut[Doorway]], outdoors: set[str]
) -> list[_Stretch]:
    """Return the outer walls of the room, interrupted by doorways."""
    mine = rects[room.name]
    others = [r for n, r in rects.items() if n != room.name]
    found = [_Stretch(edge, "") for edge in mine.outer_edges(others, VIEW_M)]
    for name in sorted(outdoors):
        edge = shared_edge(mine, rects[name])
        if edge is not None:
            found.append(_Stretch(edge, name))
    pieces = []
    for stretch in found:
        edge = stretch.edge
        taken = [
            (cut.interval[0] - GAP_M / 2, cut.interval[1] + GAP_M / 2)
            for cut in doors
            if cut.edge.along == edge.along and abs(cut.edge.at - edge.at) < 1e-6
        ]
        for start, end in subtract([(edge.start, edge.end)], taken):
            pieces.append(_Stretch(replace(edge, start=start, end=end), stretch.beyond))
    return pieces


def _assign(window: OpeningSpec, stretches: Sequence[_Stretch]) -> bool:
    """Assign the window to the stretch with most space, narrowed if necessary; False if none has enough."""
    best = max(stretches, key=lambda s: s.free_m, default=None)
    if best is None or best.free_m < min(LEAST_SHARE * window.width_m, LEAST_WIDTH_M):
        return False
    best.windows.append(replace(window, width_m=min(window.width_m, best.free_m)))
    return True


def _spread(stretch: _Stretch, room: str) -> list[WallCut[Window]]:
    """Return the windows of a stretch in a row with equal gaps."""
    if not stretch.windows:
        return []
    free = stretch.edge.length - sum(w.width_m for w in stretch.windows)
    gap = free / (len(stretch.windows) + 1)
    cuts, start = [], stretch.edge.start + gap
    for window in stretch.windows:
        sill, head = sill_and_head(window.height_m)
        edge, width = stretch.edge, window.width_m
        center = edge.point(start + width / 2)
        opening = Window((room, stretch.beyond), center, width, sill, head, edge.along, window.model)
        cuts.append(WallCut(opening, edge, (start, start + width)))
        start += width + gap
    return cuts


def sill_and_head(height_m: float) -> tuple[float, float]:
    """Return the heights of the lower and upper edge of a window of this height."""
    if height_m < TRANSOM_M:
        return HEAD_M - height_m, HEAD_M
    sill = max(LEAST_SILL_M, min(SILL_M, HEAD_M - height_m))
    return sill, min(HEAD_M, sill + height_m)
