"""Rows: equal groups on a lattice, an aisle apart: a class at its desks, tables of a restaurant, mats of a gym."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish.candidates import GroupCandidates

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.furnish.boxes import FloatArray
    from embomatrix.factory.furnish.pieces import FurnitureGroup, Rect4, Rows
    from embomatrix.factory.furnish.solver import RoomSolver

_MARGINS_M: Final = ((0.75, 0.75), (0.75, 0.05), (0.05, 0.75), (0.05, 0.05))
"""Free floor along the walls in x and y: a way around, or none."""
_SPARE: Final = 0.04
"""A node too many costs as much as this share of a group without a place."""
_LATTICES: Final = 4
"""Numbers of columns that are tried for each heading and margin, the closest to the room's own shape."""


def lay_rows(solver: RoomSolver, rows: Rows, wobble: float, rng: np.random.Generator) -> list[FurnitureGroup]:
    """Place the groups on the lattice that has room for the most of them. Returns the groups that found no place."""
    unit = _unit(rows.groups)
    best: tuple[float, GroupCandidates] | None = None
    for turns in range(4):
        for lattice in _lattices(solver, unit, rows, turns):
            nodes = GroupCandidates(
                lattice[:, 0], lattice[:, 1], np.full(len(lattice), turns), np.zeros(len(lattice))
            )
            free = nodes.take(np.flatnonzero(_all_free(solver, rows, nodes)))
            score = (
                min(len(free), len(rows.groups)) - _SPARE * len(nodes) + wobble * float(rng.uniform(0.0, 0.5))
            )
            if best is None or score > best[0]:
                best = (score, free)
    if best is None:
        return list(rows.groups)
    return _fill(solver, rows.groups, best[1])


def _fill(
    solver: RoomSolver, groups: Sequence[FurnitureGroup], nodes: GroupCandidates
) -> list[FurnitureGroup]:
    left = list(groups)
    for index in range(len(nodes)):
        if not left:
            break
        spot = float(nodes.x[index]), float(nodes.y[index]), int(nodes.turns[index])
        if solver.is_free_at(left[0], *spot) and solver.place_at(left[0], *spot):
            left.pop(0)
    return left


def _all_free(
    solver: RoomSolver, rows: Rows, nodes: GroupCandidates
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Nodes where the largest group stands free: what fits it, fits all."""
    largest = max(rows.groups, key=lambda g: len(g.members))
    return solver.free(replace(largest, clear_m=rows.clear_m), nodes)


def _unit(groups: Sequence[FurnitureGroup]) -> Rect4:
    """Bounds that hold each of the groups in its own frame."""
    bounds = np.array([g.bounds for g in groups])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _lattices(solver: RoomSolver, unit: Rect4, rows: Rows, turns: int) -> Iterator[FloatArray]:
    """Frames of the groups on lattices in the middle of the room, nodes of the first row first; each (n, 2)."""
    x0, y0, x1, y1 = unit
    room = solver.space.room
    size, gap = np.array([x1 - x0, y1 - y0]), np.array(rows.gap_m)
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    if turns % 2:
        size, gap = size[::-1], gap[::-1]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    offset = np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    for margin in _MARGINS_M:
        space = np.asarray(room.size_m) - 2 * np.array(margin)
        most = np.floor((space + gap + 1e-9) / (size + gap)).astype(int)
        if min(most) < 1:
            continue
        for nx, ny in _counts(len(rows.groups), int(most[0]), int(most[1])):
            number = np.array([nx, ny])
            pitch = size + gap
            free = np.where(number > 1, (space - size) / np.maximum(1, number - 1), pitch)
            pitch = np.clip(free, pitch, rows.stretch * pitch)
            start = np.asarray(room.center_m) - pitch * (number - 1) / 2
            gx, gy = np.meshgrid(
                start[0] + pitch[0] * np.arange(nx), start[1] + pitch[1] * np.arange(ny), indexing="ij"
            )
            nodes = np.stack([gx.ravel(), gy.ravel()], axis=1) - offset
            ahead = nodes @ np.array([c, s])
            yield nodes[np.argsort(-ahead.round(3), kind="stable")]


def _counts(wanted: int, most_x: int, most_y: int) -> list[tuple[int, int]]:
    """Columns and rows that hold as many as are wanted, those like the room and without waste first; and the whole floor."""
    found = []
    for nx in range(1, most_x + 1):
        ny = min(most_y, -(-wanted // nx))
        if nx * ny >= wanted:
            found.append((nx, ny))
    found.sort(key=lambda n: (n[0] * n[1] - wanted) / wanted + abs(n[0] / most_x - n[1] / most_y))
    return [*found[:_LATTICES], (most_x, most_y)]
