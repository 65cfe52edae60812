"""Windows of a floor plan: set into the outer walls of their rooms, between the doorways, spread over each wall."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from embomatrix.factory.floorplan.spec import OUTDOORS, WindowSpec
from embomatrix.factory.floorplan.walls import Edge, WindowCut, shared_edge, subtract

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.factory.floorplan.spec import RoomSpec
    from embomatrix.factory.floorplan.walls import DoorCut, Rect

SILL_M: Final = 0.9
HEAD_M: Final = 2.15
"""Windows end no higher: the lintel above carries the wall."""
LEAST_SILL_M: Final = 0.1
TRANSOM_M: Final = 0.6
"""Lower windows sit under the lintel, above people's heads."""
LEAST_SHARE: Final = 0.5
LEAST_WIDTH_M: Final = 2.0
"""Windows are cut to the wall that they go into, but not below half their width or these metres, whichever is less."""
GAP_M: Final = 0.25
"""Wall between two windows, and between a window and a doorway or a corner."""
VIEW_M: Final = 0.8
"""Open air behind a window."""
SKYLIGHT_M: Final = 6.0
"""What is listed as higher than this, in a house with walls of 2.4 m, is part of a roof or a facade."""


@dataclass(slots=True)
class _Stretch:
    """A piece of outer wall, ``beyond`` the room behind it, and the windows that go into it."""

    edge: Edge
    beyond: str
    windows: list[WindowSpec] = field(default_factory=list)

    @property
    def free_m(self) -> float:
        """Width that one more window may have."""
        return self.edge.length - sum(w.width_m + GAP_M for w in self.windows) - 2 * GAP_M


def place_windows(
    rooms: Sequence[RoomSpec], rects: Mapping[str, Rect], doors: Sequence[DoorCut]
) -> tuple[list[WindowCut], list[str]]:
    """Openings for the windows of all rooms, and a sentence on those that found no wall.

    A window goes into the longest free stretch of its room's outer walls; a garden behind the wall counts as outside, so what a
    garden lists are the windows of the rooms around it. One that is wider than the wall allows is cut to it.
    """
    outdoors = {r.name for r in rooms if r.type in OUTDOORS}
    cuts: list[WindowCut] = []
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
    room: RoomSpec, rects: Mapping[str, Rect], doors: Sequence[DoorCut], outdoors: set[str]
) -> list[_Stretch]:
    """Outer walls of the room without the doorways in them."""
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


def _assign(window: WindowSpec, stretches: Sequence[_Stretch]) -> bool:
    """Give the window to the stretch with most room, narrower than listed where need be; False when none has any."""
    best = max(stretches, key=lambda s: s.free_m, default=None)
    if best is None or best.free_m < min(LEAST_SHARE * window.width_m, LEAST_WIDTH_M):
        return False
    best.windows.append(replace(window, width_m=min(window.width_m, best.free_m)))
    return True


def _spread(stretch: _Stretch, room: str) -> list[WindowCut]:
    """The windows of a stretch in a row, with equal gaps."""
    if not stretch.windows:
        return []
    free = stretch.edge.length - sum(w.width_m for w in stretch.windows)
    gap = free / (len(stretch.windows) + 1)
    cuts, start = [], stretch.edge.start + gap
    for window in stretch.windows:
        sill, head = sill_and_head(window.height_m)
        cuts.append(
            stretch.edge.glaze((room, stretch.beyond), start, window.width_m, sill, head, window.model)
        )
        start += window.width_m + gap
    return cuts


def sill_and_head(height_m: float) -> tuple[float, float]:
    """Heights above the floor between which a window of this height opens the wall."""
    if height_m < TRANSOM_M:
        return HEAD_M - height_m, HEAD_M
    sill = max(LEAST_SILL_M, min(SILL_M, HEAD_M - height_m))
    return sill, min(HEAD_M, sill + height_m)
