"""Planar-Level Placement Generator: beam search for a joint arrangement of objects on one plane.

Two constraints are hard, as in the paper: objects don't overlap, and the robot can stand where it reaches them.
Required constraints are hard as well; the others add their weights to a score. Objects are modelled as boxes around
rotated footprints. Free spots are really free, but some free spots are rejected.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.layout.constraints import (
    GRADED_SHARE,
    WEIGHTS,
    BoolArray,
    FloatArray,
    SpotCandidates,
    gaps,
    half_extents,
    holds,
    margins,
    satisfaction,
)
from embomatrix.factory.layout.organization import named_first
from embomatrix.factory.layout.values import (
    ConstraintKind,
    PlaneArrangement,
    PlaneBrief,
    PlaneFootprint,
    PlaneObject,
    PlaneSpot,
    Size2,
)
from embomatrix.factory.scenes.editor import LayoutReason
from embomatrix.skills.limits import ROBOT

BEAMS: Final = 3
BRANCHES: Final = 6
RESULTS: Final = 8
SURFACE_CELLS: Final = 900
FLOOR_CELLS: Final = 1800
STEP_M: Final = (0.01, 0.05)
"""Finest grid step on furniture and on floors. Larger planes get coarser steps, so that the number of cells is bounded."""
GAP_M: Final = 0.01
"""Free strip around an object."""
CLEARANCE_M: Final = 0.06
CLEARANCE_BONUS: Final = 0.3
"""Bonus for a distance of ``CLEARANCE_M`` from other objects and from the rim."""
FRONT_BONUS: Final = 0.4
"""Bonus for facing the same way as the furniture, or for lying along it."""
WALL_BONUS: Final = 1.5
"""Bonus for furniture with its back to the nearest wall."""
RANDOM_SCORE: Final = 0.25
"""Amplitude of the random score, so that layouts differ."""
LEFT_OUT_PENALTY: Final = 6.0
"""Penalty for an object without a spot. It exceeds every constraint's weight."""
BATCH: Final = 96
"""Number of spots whose reach is checked together, the best first."""
MAX_SCANNED: Final = 12 * BATCH
YAWS: Final = (0.0, math.pi / 2, math.pi, -math.pi / 2)
REACH_M: Final = ROBOT.reach_m - 0.05


@dataclass(frozen=True, slots=True)
class _Beam:
    spots: tuple[PlaneSpot, ...] = ()
    footprints: tuple[PlaneFootprint, ...] = ()
    score: float = 0.0
    left_out: tuple[tuple[str, LayoutReason], ...] = ()


def arrange(brief: PlaneBrief) -> tuple[PlaneArrangement, ...]:
    """Return joint arrangements of the brief's objects, the best first, at least one. Each lists the objects left out."""
    grown = [_Beam()]
    largest_first = sorted(brief.objects, key=lambda item: -item.size_m[0] * item.size_m[1])
    for item in named_first(largest_first, lambda item: (each.other for each in item.constraints)):
        grown = sorted(
            (child for beam in grown[:BEAMS] for child in _extended(brief, item, beam)),
            key=lambda beam: -beam.score,
        )
    return tuple(PlaneArrangement(beam.spots, beam.score, dict(beam.left_out)) for beam in grown[:RESULTS])


def _extended(brief: PlaneBrief, item: PlaneObject, beam: _Beam) -> list[_Beam]:
    """Extend the beam by the object at each of its best spots, or without the object if it has none."""
    search = _Search(brief, item, beam.footprints)
    found = search.best()
    if isinstance(found, LayoutReason):
        return [
            replace(beam, score=beam.score - LEFT_OUT_PENALTY, left_out=(*beam.left_out, (item.name, found)))
        ]
    return [
        _Beam(
            (*beam.spots, spot),
            (*beam.footprints, search.footprint(spot)),
            beam.score + score,
            beam.left_out,
        )
        for spot, score in found
    ]


class _Search:
    """Search for spots of one object, given the positions of the others."""

    def __init__(self, brief: PlaneBrief, item: PlaneObject, placed: tuple[PlaneFootprint, ...]) -> None:
        self._brief = brief
        self._item = item
        self._others = {item.name: item for item in (*brief.obstacles, *placed)}
        self._rng = np.random.default_rng((brief.seed, len(placed), 11))

    def footprint(self, spot: PlaneSpot) -> PlaneFootprint:
        x, y, height = self._item.size_m
        return PlaneFootprint(self._item.name, spot.center_m, spot.yaw, (x, y), 0.0, height)

    def best(self) -> list[tuple[PlaneSpot, float]] | LayoutReason:
        """Return the best spots with their scores, apart from one another, or the reason if there is none."""
        spots = self._candidates()
        spots = spots.at(margins(spots, self._brief.size_m) >= self._brief.rim_m - 1e-9)
        if not len(spots):
            return LayoutReason.TOO_LARGE
        spots = spots.at(~self._taken(spots))
        if not len(spots):
            return LayoutReason.NO_FREE_SPOT
        held = [self._holds(number, spots) for number in range(len(self._item.constraints))]
        needed = [
            row for row, constraint in zip(held, self._item.constraints, strict=True) if constraint.required
        ]
        if needed:
            fits = np.logical_and.reduce(needed)
            spots, held = spots.at(fits), [row[fits] for row in held]
        if not len(spots):
            return LayoutReason.RELATION_NOT_HELD
        return self._chosen(spots, held, self._scores(spots, held))

    def _candidates(self) -> SpotCandidates:
        """Return grid points with all yaws.

        Lines through the objects that constraints name, and yaws that face them, are added.
        """
        brief = self._brief
        width, depth = brief.size_m
        most = FLOOR_CELLS if brief.on_floor else SURFACE_CELLS
        step = max(STEP_M[brief.on_floor], math.sqrt(width * depth / most))
        about = [self._others[w.other] for w in self._item.constraints if w.other in self._others]
        xs, ys = (
            np.unique(np.concatenate([_grid_line(extent, step), [item.center_m[axis] for item in about]]))
            for axis, extent in enumerate((width, depth))
        )
        points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)  # (k, 2)
        gazes = [
            np.arctan2(*(np.asarray(self._others[constraint.other].center_m) - points).T[::-1])
            for constraint in self._item.constraints
            if constraint.kind is ConstraintKind.FACE_TO and constraint.other in self._others
        ]
        turns = YAWS if self._item.has_front else YAWS[:2]
        yaws = np.concatenate([*(np.full(len(points), turn) for turn in turns), *gazes])
        return SpotCandidates.of(np.tile(points, (len(turns) + len(gazes), 1)), yaws, self._item.size_m)

    def _taken(self, spots: SpotCandidates) -> BoolArray:
        """Mask of spots that collide with an object or lie in a zone that stays free, shape (n,)."""
        height = self._item.size_m[2]
        rows = [
            (*item.center_m, *(half_extents(np.asarray(item.yaw), item.size_m) + GAP_M).tolist())
            for item in self._others.values()
            if item.low_m < height and item.high_m > 0.0
        ]
        rows += [((a + c) / 2, (b + d) / 2, (c - a) / 2, (d - b) / 2) for a, b, c, d in self._brief.zones]
        table = np.asarray(rows, dtype=np.float64).reshape(-1, 4)
        meets = np.ones((len(spots), len(table)), dtype=bool)
        for axis in (0, 1):
            apart = np.abs(spots.center[:, axis, None] - table[None, :, axis])
            meets &= apart < spots.half[:, axis, None] + table[None, :, axis + 2]
        return np.asarray(meets.any(axis=1))

    def _holds(self, number: int, spots: SpotCandidates) -> BoolArray:
        constraint = self._item.constraints[number]
        other = self._others.get(constraint.other)
        return holds(constraint, spots, self._brief.size_m, self._item.size_m, other)

    def _scores(self, spots: SpotCandidates, held: Sequence[BoolArray]) -> FloatArray:
        brief, item = self._brief, self._item
        score = RANDOM_SCORE * self._rng.random(len(spots))
        kinds = {constraint.kind for constraint in item.constraints}
        for constraint, row in zip(item.constraints, held, strict=True):
            shade = satisfaction(constraint, spots, brief.size_m, self._others.get(constraint.other))
            score += WEIGHTS[constraint.kind] * ((1 - GRADED_SHARE) * row + GRADED_SHARE * shade)
        if ConstraintKind.EDGE not in kinds:
            score += CLEARANCE_BONUS * np.minimum(margins(spots, brief.size_m) / CLEARANCE_M, 1.0)
        nearest = [gaps(spots, item) for item in self._others.values()]
        if nearest:
            score += CLEARANCE_BONUS * np.minimum(np.min(nearest, axis=0) / CLEARANCE_M, 1.0)
        if item.has_front and ConstraintKind.FACE_TO not in kinds:
            looks = _inward_facing(spots, brief.size_m) if brief.on_floor else np.cos(spots.yaw)
            score += (WALL_BONUS if brief.on_floor else FRONT_BONUS) * (looks > 0.9)
        elif not item.has_front and not brief.on_floor:
            score += FRONT_BONUS / 2 * (spots.half[:, 1] >= spots.half[:, 0])
        return np.asarray(score)

    def _chosen(
        self, spots: SpotCandidates, held: Sequence[BoolArray], scores: FloatArray
    ) -> list[tuple[PlaneSpot, float]] | LayoutReason:
        """Return the best reachable spots.

        Spots closer than a quarter of the plane's shorter side to a better one are skipped.
        """
        apart = 0.25 * min(self._brief.size_m)
        chosen: list[tuple[PlaneSpot, float]] = []
        order = np.argsort(-scores, kind="stable")[:MAX_SCANNED]
        for start in range(0, len(order), BATCH):
            rows = order[start : start + BATCH]
            for row in rows[self._reached(spots.at(rows))].tolist():
                x, y = spots.center[row].tolist()
                if any(math.hypot(x - s.center_m[0], y - s.center_m[1]) < apart for s, _ in chosen):
                    continue
                kept = tuple(w for w, h in zip(self._item.constraints, held, strict=True) if h[row])
                chosen.append(
                    (PlaneSpot(self._item.name, (x, y), float(spots.yaw[row]), kept), float(scores[row]))
                )
                if len(chosen) == BRANCHES:
                    return chosen
            if chosen and start >= 2 * BATCH:
                break
        return chosen or LayoutReason.OUT_OF_REACH

    def _reached(self, spots: SpotCandidates) -> BoolArray:
        """Mask of spots that the arm reaches from a robot position, shape (n,)."""
        if not self._brief.stands:
            return np.ones(len(spots), dtype=bool)
        stands = np.asarray(self._brief.stands)  # (k, 2)
        off = np.abs(stands[None] - spots.center[:, None]) - spots.half[:, None]  # (n, k, 2)
        away = np.hypot(*np.moveaxis(np.maximum(off, 0.0), -1, 0))
        return np.asarray(((away >= ROBOT.shoulder_m) & (away <= REACH_M)).any(axis=1))


def _inward_facing(spots: SpotCandidates, plane_m: Size2) -> FloatArray:
    """Cosine between each spot's front and the inward normal of the nearest side, shape (n,)."""
    strips = np.asarray(plane_m) / 2 - np.abs(spots.center) - spots.half  # (n, 2)
    axis = np.argmin(strips, axis=1)
    inward = -np.sign(spots.center[np.arange(len(spots)), axis])
    front = np.stack([np.cos(spots.yaw), np.sin(spots.yaw)], axis=1)
    return np.asarray(inward * front[np.arange(len(spots)), axis])


def _grid_line(extent: float, step: float) -> NDArray[np.float64]:
    """Return grid coordinates along one side, symmetric about the centre."""
    count = int(extent / 2 / step)
    return np.asarray(np.arange(-count, count + 1) * step, dtype=np.float64)
