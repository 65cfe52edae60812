"""Fit of the aesthetics score to hand-made rooms, and its test on rooms outside the fit."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.factory.evaluate.aesthetics import (
    BY_KIND,
    EDGES,
    PROPERTIES,
    Binned,
    Calibration,
    EvidenceTables,
    FloatArray,
    Property,
    RoomObservation,
    ScorePart,
    parts_from,
    score_of,
)
from embomatrix.factory.evaluate.room_plans import RoomPlan, read_rooms
from embomatrix.factory.evaluate.spoilers import SPOILERS
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.pages.figures import Better, Figure

FEWEST_PIECES: Final = 3
"""Least number of pieces of furniture in a hand-made room that is used."""
AUC_GOAL: Final = 0.9
FOLDS: Final = 10
INNER_FOLDS: Final = 4
"""Folds within a fit: weights are fitted to evidence from tables that lack the room."""
COPIES: Final = 3
"""Corrupted copies of each room and spoiler."""
RESAMPLES: Final = 1000
STEPS: Final = 1500
RATE: Final = 0.5
DECAY: Final = 1e-2
DIGITS: Final = 3

SPOILT_PART: Final[Mapping[ScorePart, frozenset[str]]] = {
    ScorePart.FURNITURE_APART: frozenset({"shifted", "dropped"}),
    ScorePart.THINGS_APART: frozenset({"swapped", "dropped", "scattered"}),
    ScorePart.FURNITURE_PLACED: frozenset({"shifted", "dropped"}),
    ScorePart.THINGS_SQUARE: frozenset({"scattered"}),
    ScorePart.HOSTS_USUAL: frozenset({"swapped"}),
}
"""Spoilers that a part of the score is fitted against: those that change its properties."""
PART_OF: Final = {name: part for part, names in PROPERTIES.items() for name in names}


@dataclass(frozen=True, slots=True)
class SpoiltRoom:
    """RoomObservation of a hand-made room, and those of its corrupted copies by spoiler."""

    family: str
    room: RoomObservation
    copies: Mapping[str, tuple[RoomObservation, ...]]

    @staticmethod
    def of(room: RoomPlan, rng: np.random.Generator) -> SpoiltRoom:
        """Return the room with `COPIES` copies by each spoiler."""
        copies = {
            name: tuple(RoomObservation.of(spoil(room, rng)) for _ in range(COPIES))
            for name, spoil in SPOILERS.items()
        }
        return SpoiltRoom(room.family, RoomObservation.of(room), copies)


def fit(rooms: Sequence[SpoiltRoom]) -> Calibration:
    """Fit tables to all rooms and weights to evidence from tables without the room's family.

    Without this cross-fitting, the weights would trust tables that have counted the room itself.
    """
    families = {name: number for number, name in enumerate(sorted({each.family for each in rooms}))}
    evidence: list[tuple[str, Mapping[Property, float]]] = []
    for fold in range(INNER_FOLDS):
        inside = [each for each in rooms if families[each.family] % INNER_FOLDS != fold]
        tables = EvidenceTables(_counted(inside))
        for each in rooms:
            if families[each.family] % INNER_FOLDS == fold:
                evidence.append(("", each.room.evidence(tables)))
                evidence += [(name, copies[0].evidence(tables)) for name, copies in each.copies.items()]
    weights: dict[ScorePart, dict[Property, float]] = {}
    bias: dict[ScorePart, float] = {}
    for part, names in PROPERTIES.items():
        rows = [
            (not spoiler, [found.get(name, 0.0) for name in names])
            for spoiler, found in evidence
            if not spoiler or spoiler in SPOILT_PART[part]
        ]
        truth = np.array([real for real, _ in rows], dtype=np.float64)
        fitted, offset = logistic(np.array([row for _, row in rows]), truth)
        weights[part] = {name: round(float(value), DIGITS) for name, value in zip(names, fitted, strict=True)}
        bias[part] = round(offset, DIGITS)
    return replace(_counted(rooms), weights=weights, bias=bias)


def logistic(table: FloatArray, truth: FloatArray) -> tuple[FloatArray, float]:
    """Return weights of a balanced logistic regression by projected gradient descent, none below 0, and its bias.

    table: (rooms, features), truth: (rooms,) of 1 for hand-made and 0 for corrupted.
    """
    mean, scale = table.mean(axis=0), table.std(axis=0) + 1e-6  # (features,) each
    scaled = (table - mean) / scale
    balance = np.where(truth > 0, 0.5 / truth.mean(), 0.5 / (1 - truth.mean()))  # (rooms,)
    weights, bias = np.full(table.shape[1], 0.3), 0.0
    for _ in range(STEPS):
        error = balance * (1 / (1 + np.exp(-(scaled @ weights + bias))) - truth)  # (rooms,)
        slope = scaled.T @ error / len(truth) + DECAY * weights  # (features,)
        weights = np.maximum(0.0, weights - RATE * slope)
        bias -= RATE * float(error.mean())
    return weights / scale, float(bias - mean @ (weights / scale))


def _counted(rooms: Sequence[SpoiltRoom]) -> Calibration:
    """Return the calibration's tables without weights."""
    real = _counts(mark for each in rooms for mark in each.room.bins)
    spoilt = _counts(
        mark
        for each in rooms
        for spoiler, copies in each.copies.items()
        for copy in copies
        for mark in copy.bins
        if spoiler in SPOILT_PART[PART_OF[mark[0]]]
    )
    hosts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for each in rooms:
        for kind, at in zip(each.room.kinds, each.room.chosen, strict=True):
            hosts[kind][each.room.hosts[at]] += 1
    return Calibration(
        real={name: {kind: row.tolist() for kind, row in kinds.items()} for name, kinds in real.items()},
        spoilt={name: np.sum([*kinds.values()], axis=0).tolist() for name, kinds in spoilt.items()},
        hosts={kind: dict(sorted(found.items())) for kind, found in sorted(hosts.items())},
        weights={},
        bias={},
    )


def _counts(marks: Iterable[Binned]) -> dict[Property, dict[str, FloatArray]]:
    """Count bins by property, and by kind where kinds differ; "" stands for all kinds."""
    found: dict[Property, dict[str, FloatArray]] = {name: {} for name in EDGES}
    for name, kind, at in marks:
        counts = found[name].setdefault(kind if name in BY_KIND else "", np.zeros(len(EDGES[name]) + 1))
        counts[at] += 1
    return {name: dict(sorted(kinds.items())) for name, kinds in found.items() if kinds}


def auc(good: FloatArray, spoilt: FloatArray) -> float:
    """Return the probability that a good room scores above a corrupted one; ties count half (Mann and Whitney 1947)."""
    above = (good[:, None] > spoilt[None, :]).mean()
    return float(above + (good[:, None] == spoilt[None, :]).mean() / 2)


@dataclass(frozen=True, slots=True)
class HeldOutScores:
    """Scores by fits that have not seen the room's family: ``real`` (rooms,), ``spoilt`` (rooms, copies) by spoiler."""

    families: tuple[str, ...]
    real: FloatArray
    spoilt: Mapping[str, FloatArray]

    def auc(self, spoiler: str) -> float:
        """Return the AUC against one spoiler, or against all for ""."""
        return self._auc(spoiler, np.arange(len(self.real)))

    def interval(self, spoiler: str, rng: np.random.Generator) -> tuple[float, float]:
        """Return the 95 % interval of the AUC by a bootstrap over families."""
        members: defaultdict[str, list[int]] = defaultdict(list)
        for at, family in enumerate(self.families):
            members[family].append(at)
        groups = [*members.values()]
        found = []
        for _ in range(RESAMPLES):
            drawn = rng.integers(len(groups), size=len(groups))
            found.append(self._auc(spoiler, np.concatenate([groups[int(at)] for at in drawn])))
        low, high = np.percentile(found, [2.5, 97.5])
        return float(low), float(high)

    def _auc(self, spoiler: str, rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> float:
        names = [spoiler] if spoiler else [*self.spoilt]
        return auc(self.real[rows], np.concatenate([self.spoilt[name][rows].ravel() for name in names]))


def held_out_scores(rooms: Sequence[SpoiltRoom], rng: np.random.Generator) -> HeldOutScores:
    """Score every room and its copies once, by the fit to the families of the other folds."""
    names = sorted({each.family for each in rooms})
    fold_of = {names[int(name)]: place % FOLDS for place, name in enumerate(rng.permutation(len(names)))}
    real = np.zeros(len(rooms))
    spoilt = {name: np.zeros((len(rooms), COPIES)) for name in SPOILERS}
    for fold in range(FOLDS):
        calibration = fit([each for each in rooms if fold_of[each.family] != fold])
        tables = EvidenceTables(calibration)
        for at, each in enumerate(rooms):
            if fold_of[each.family] == fold:
                real[at] = _score(each.room, tables, calibration)
                for name, copies in each.copies.items():
                    spoilt[name][at] = [_score(copy, tables, calibration) for copy in copies]
    return HeldOutScores(tuple(each.family for each in rooms), real, spoilt)


def _score(room: RoomObservation, tables: EvidenceTables, calibration: Calibration) -> float:
    return score_of(parts_from(room.evidence(tables), calibration))


def half_added(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Return the room with a random half of its objects as the added ones."""
    pieces, things = (rng.permutation(len(found)) for found in (room.pieces, room.things))
    return replace(
        room,
        added_pieces=tuple(sorted(int(at) for at in pieces[: (len(pieces) + 1) // 2])),
        added_things=tuple(sorted(int(at) for at in things[: (len(things) + 1) // 2])),
    )


def evaluate_aesthetics(rooms_file: Path, seed: int) -> tuple[EvaluationFigures, Calibration]:
    """Measure how well scores separate rooms from corrupted copies; return also the calibration fitted to all rooms.

    Each room is scored by a fit to other families. Raises EvaluationError.
    """
    plans = [room for room in read_rooms(rooms_file) if len(room.pieces) >= FEWEST_PIECES]
    families = {room.family for room in plans}
    if len(families) < FOLDS:
        raise EvaluationError(
            f"{rooms_file} holds {len(families)} families of rooms with furniture: expected {FOLDS} or more, one per fold"
        )
    rng = np.random.default_rng(seed)
    rooms = [SpoiltRoom.of(room, rng) for room in plans]
    whole = held_out_scores(rooms, rng)
    half = held_out_scores([SpoiltRoom.of(half_added(room, rng), rng) for room in plans], rng)
    n = len(rooms)
    figures = [Figure("aesthetics_auc", whole.auc(""), "", Better.HIGHER, n, AUC_GOAL)]
    notes = [_interval("aesthetics_auc", whole.interval("", rng))]
    for name in SPOILERS:
        label = f"aesthetics_auc {name}"
        figures.append(Figure(label, whole.auc(name), "", Better.HIGHER, n, AUC_GOAL))
        notes.append(_interval(label, whole.interval(name, rng)))
    for name in ("", *SPOILERS):
        label = f"aesthetics_auc half added {name}".strip()
        figures.append(Figure(label, half.auc(name), "", Better.NEITHER, n))
    spoilt = np.concatenate([scores.ravel() for scores in whole.spoilt.values()])
    figures += [
        Figure("aesthetics hand-made", float(whole.real.mean()), "of 10", Better.NEITHER, n),
        Figure("aesthetics spoilt", float(spoilt.mean()), "of 10", Better.NEITHER, len(spoilt)),
    ]
    conditions = {"rooms": n, "families": len(families), "folds": FOLDS, "copies": COPIES, "seed": seed}
    note = f"95 % intervals by a bootstrap over families: {'; '.join(notes)}."
    return EvaluationFigures("aesthetics", conditions, tuple(figures), (note,)), fit(rooms)


def _interval(label: str, ends: tuple[float, float]) -> str:
    return f"{label} [{ends[0]:.3f}, {ends[1]:.3f}]"
