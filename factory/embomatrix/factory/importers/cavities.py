"""Surfaces and cavities of imported models, found in a grid of cells over their convex parts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from embomatrix.world.geometry import Aabb, FloatArray, Vec3

Grid = NDArray[np.bool_]
Cells = NDArray[np.int64]

CELLS: Final = 40
"""Cells along each side of the box: a thinner part than 1/40 of it may be missed."""
LEAST_SHARE: Final = 0.12
"""Least share of the box along x and y for a surface or cavity."""
MAX_CAVITIES: Final = 12
REMNANT_SHARE: Final = 0.25
"""The remainder beside a cavity counts as a separate cavity from this share of the cavity's volume."""
FLOOR_SHARE: Final = 0.6
"""Least solid share of a cavity's floor: boards may have slots."""


@dataclass(frozen=True, slots=True)
class Cavity:
    """Box of free space. ``roofed`` means that something solid is above it, so nothing can stick out of its top."""

    box: Aabb
    roofed: bool


def solid_cells(planes: Sequence[tuple[FloatArray, FloatArray]], size_m: Vec3) -> Grid:
    """Mark the cells with their centre in a part, shape (40, 40, 40). planes: (normals (n, 3), offsets (n,)) of each part."""
    ticks = [(np.arange(CELLS) + 0.5) / CELLS * extent - extent / 2 for extent in size_m]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.zeros(len(points), dtype=np.bool_)
    # Half a cell of margin: a board thinner than a cell must not fall between two centres.
    margin = min(size_m) / CELLS / 2
    for normals, offsets in planes:
        inside |= (points @ normals.T <= offsets + margin).all(axis=1)
    return inside.reshape(CELLS, CELLS, CELLS)


def top_surface(solid: Grid, size_m: Vec3) -> Aabb | None:
    """Return the largest level rectangle that is open above, as a box of zero height; None if all are too small."""
    heights = np.where(solid.any(axis=2), CELLS - np.argmax(solid[:, :, ::-1], axis=2), 0)  # (x, y)
    best: tuple[int, tuple[int, int, int, int], int] = (0, (0, 0, 0, 0), 0)
    for level in np.unique(heights[heights > 0]):
        area, rectangle = largest_rectangle(heights == level)
        best = max(best, (area, rectangle, int(level)))
    area, (x0, y0, x1, y1), level = best
    if area == 0 or min(x1 - x0, y1 - y0) < LEAST_SHARE * CELLS:
        return None
    return _box((x0, y0, level), (x1, y1, level), size_m)


def cavities(solid: Grid, size_m: Vec3) -> tuple[Cavity, ...]:
    """Return the largest boxes of free cells with a floor and three walls, from the bottom up: shelves, bays of drawers.

    A free cell has something solid below, behind, and on both sides. Doors are not in ``solid``: the front or the top is open.
    """
    free = ~solid
    for axis, ahead in ((0, False), (1, False), (1, True), (2, False)):
        free &= _behind(solid, axis, ahead=ahead)
    found: list[Cavity] = []
    taken: list[tuple[Cells, Cells]] = []
    for _ in range(MAX_CAVITIES):
        box = _largest_box(free)
        if box is None:
            break
        low, high = box
        if (
            min(high - low) >= LEAST_SHARE * CELLS
            and _has_floor(solid, low, high)
            and not any(_is_remnant(low, high, *other) for other in taken)
        ):
            taken.append((low, high))
            above = solid[low[0] : high[0], low[1] : high[1], high[2] :]
            found.append(Cavity(_box(tuple(low), tuple(high), size_m), bool(above.any())))
        free[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = False
    return tuple(sorted(found, key=lambda item: (item.box.low_m[2], item.box.low_m[1])))


def _largest_box(free: Grid) -> tuple[Cells, Cells] | None:
    """Grow a box of free cells, side by side, from the cell that is farthest from all others."""
    room = ndimage.distance_transform_cdt(np.pad(free, 1), metric="chessboard")[1:-1, 1:-1, 1:-1]
    if room.max() < 2:
        return None
    low = np.array(np.unravel_index(int(room.argmax()), room.shape))
    high = low + 1
    grown = True
    while grown:
        grown = False
        for axis in range(3):
            for end in (0, 1):
                grown |= _grow(free, low, high, axis, end)
    return low, high


def _is_remnant(low: Cells, high: Cells, other_low: Cells, other_high: Cells) -> bool:
    """True if the box is the remainder of a round or bevelled cavity beside a much larger box."""
    is_beside = bool((low <= other_high).all() and (other_low <= high).all())
    return is_beside and bool(np.prod(high - low) < REMNANT_SHARE * np.prod(other_high - other_low))


def _has_floor(solid: Grid, low: Cells, high: Cells) -> bool:
    """True if most cells right below a box are solid."""
    below = solid[low[0] : high[0], low[1] : high[1], low[2] - 1] if low[2] > 0 else np.zeros(1)
    return bool(below.mean() >= FLOOR_SHARE)


def _grow(free: Grid, low: Cells, high: Cells, axis: int, end: int) -> bool:
    """Move one face of the box outwards by a cell if all cells of that layer are free."""
    at = low[axis] - 1 if end == 0 else high[axis]
    if not 0 <= at < CELLS:
        return False
    spans = [slice(a, b) for a, b in zip(low, high, strict=True)]
    spans[axis] = slice(at, at + 1)
    if not free[tuple(spans)].all():
        return False
    if end == 0:
        low[axis] -= 1
    else:
        high[axis] += 1
    return True


def _behind(solid: Grid, axis: int, *, ahead: bool) -> Grid:
    """Mark the cells with something solid farther along an axis: ahead of them or behind."""
    flipped = np.flip(solid, axis) if ahead else solid
    seen = np.maximum.accumulate(flipped, axis=axis)
    return np.flip(seen, axis) if ahead else seen


def largest_rectangle(mask: NDArray[np.bool_]) -> tuple[int, tuple[int, int, int, int]]:
    """Return area and corners (x0, y0, x1, y1) of the largest rectangle of True cells, by row-wise histograms."""
    best, corners = 0, (0, 0, 0, 0)
    runs = np.zeros(mask.shape[1], dtype=np.int64)
    for row, cells in enumerate(mask):
        runs = np.where(cells, runs + 1, 0)
        stack: list[int] = []
        for column in range(len(runs) + 1):
            height = int(runs[column]) if column < len(runs) else 0
            while stack and runs[stack[-1]] >= height:
                top = int(runs[stack.pop()])
                left = stack[-1] + 1 if stack else 0
                if top * (column - left) > best:
                    best = top * (column - left)
                    corners = (row - top + 1, left, row + 1, column)
            stack.append(column)
    return best, corners


def _box(low: tuple[int, ...], high: tuple[int, ...], size_m: Vec3) -> Aabb:
    """Return the box in metres between two corners in cells."""
    (a, b, c), (d, e, f) = (
        tuple(float(v) / CELLS * extent - extent / 2 for v, extent in zip(corner, size_m, strict=True))
        for corner in (low, high)
    )
    return Aabb((a, b, c), (d, e, f))
