"""Geometric score of a room's layout, from 0 to 10, with weights fitted to hand-made rooms.

The score follows the paper's rubric. Correspondence gives 2 points, since every finished layout has all of a task's objects.
Clutter and placement give up to 4 points each: weighted means of features in [0, 1]. A logistic regression, with weights
bounded below by 0, fits the weights so that hand-made rooms score higher than corrupted copies of them.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from embomatrix.factory.evaluate.room_plans import FLOOR, RoomBox, RoomPlan, read_rooms
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.pages.figures import Better, Figure

FloatArray = NDArray[np.float64]

CELL_M: Final = 0.1
ROBOT_M: Final = 0.2
"""Radius of the robot in the test of free floor, as in SceneEval and PhyScene."""
WALL_M: Final = 0.15
"""Greatest distance to the edge of the room for furniture at a wall."""
STRAIGHT_RAD: Final = math.radians(2)
SEAT_M: Final = 0.5
"""Greatest distance between a seat and its table."""
SLACK_M: Final = 0.02
AT_WALL: Final = frozenset(
    {"bed", "desk", "tv_stand", "fridge", "counter_top", "floor_lamp", "dresser", "toilet", "side_table", "shelving_unit",
     "wardrobe", "bathtub", "stove", "oven", "washer", "clothes_dryer", "dishwasher"}
)  # fmt: skip
SEATS: Final = frozenset({"chair", "stool", "taboret", "bar_stool"})
TABLES: Final = frozenset({"dining_table", "desk", "counter_top", "bar", "coffee_table", "side_table"})
CLUTTER: Final = ("apart", "things_apart", "walkable", "within")
PLACEMENT: Final = ("at_wall", "straight", "seated", "hosted", "in_reach")
RAREST: Final = 0.02
"""Share of a host, relative to the commonest host, below which it counts as unused."""
REACH_M: Final = (0.2, 1.5)
"""Heights that the robot's arm reaches."""
FILE: Final = "aesthetics.json"


@dataclass(frozen=True, slots=True)
class Calibration:
    """Fitted parameters: ``weights`` by feature, none below 0, and ``hosts``, shares of hosts by kind of object."""

    weights: Mapping[str, float]
    hosts: Mapping[str, Mapping[str, float]]

    @staticmethod
    def load() -> Calibration:
        """Return the packaged calibration; NOTICE.md names the rooms that it was fitted to."""
        path = resources.files("embomatrix.factory.evaluate") / FILE
        value = json.loads(path.read_text(encoding="utf-8"))
        return Calibration(value["weights"], value["hosts"])


def score_room(plan: RoomPlan, calibration: Calibration) -> float:
    """Return the score of a room in which all requested objects are present."""
    features = features_of(plan, calibration.hosts)
    clutter = _weighted(features, CLUTTER, calibration.weights)
    return 2 + 4 * clutter + 4 * _weighted(features, PLACEMENT, calibration.weights)


def _weighted(features: Mapping[str, float], names: Sequence[str], weights: Mapping[str, float]) -> float:
    """Return the weighted mean of the named features that apply to the room; 1 if none applies."""
    known = [name for name in names if name in features]
    whole = sum(weights[name] for name in known)
    return sum(weights[name] * features[name] for name in known) / whole if whole else 1.0


def features_of(plan: RoomPlan, hosts: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the features that apply to the room, in [0, 1]; 1 is best."""
    walled = [item for item in plan.pieces if item.kind in AT_WALL]
    seats = [item for item in plan.pieces if item.kind in SEATS]
    tables = [item for item in plan.pieces if item.kind in TABLES]
    known = [item for item in plan.things if item.kind in hosts]
    found = {
        "apart": [not _bumps(plan.pieces, at) for at in range(len(plan.pieces))],
        "things_apart": [not _bumps(plan.things, at) for at in range(len(plan.things))],
        "within": [_is_within(item, plan) for item in plan.pieces],
        "at_wall": [_wall_gap_m(item, plan) <= WALL_M for item in walled],
        "straight": [abs(item.tilt_rad) <= STRAIGHT_RAD for item in plan.pieces if item.kind not in SEATS],
        "seated": [any(_gap_m(seat, table) <= SEAT_M for table in tables) for seat in seats if tables],
        "in_reach": [REACH_M[0] <= item.low_m <= REACH_M[1] for item in plan.things],
    }
    features = {name: float(np.mean(held)) for name, held in found.items() if held}
    if known:
        features["hosted"] = float(
            np.mean([_fitness(hosts[item.kind].get(item.host, 0.0)) for item in known])
        )
    features["walkable"] = walkable_share(plan)
    return features


def _fitness(share: float) -> float:
    """Return the fitness of a host: 1 for the commonest, 0 for an unused one, logarithmic in its share between."""
    return 1 - math.log(max(share, RAREST)) / math.log(RAREST)


def walkable_share(plan: RoomPlan) -> float:
    """Return the largest connected part of the floor that the robot can drive through, as a share of the free floor."""
    low, high = np.array(plan.low_m), np.array(plan.high_m)
    counts = np.maximum(1, np.ceil((high - low) / CELL_M)).astype(int)
    x = low[0] + (np.arange(counts[0]) + 0.5) * CELL_M
    y = low[1] + (np.arange(counts[1]) + 0.5) * CELL_M
    free = np.ones(counts, dtype=bool)  # (nx, ny)
    wide = free.copy()
    for item in plan.pieces:
        for grid, margin in ((free, 0.0), (wide, ROBOT_M)):
            reach = item.reach_m
            inside_x = np.abs(x - item.center_m[0]) <= reach[0] + margin
            inside_y = np.abs(y - item.center_m[1]) <= reach[1] + margin
            grid[np.ix_(inside_x, inside_y)] = False
    labels, count = ndimage.label(wide)
    if not count or not free.any():
        return 0.0
    return float(np.bincount(labels.ravel())[1:].max() / free.sum())


def hosts_in(rooms: Sequence[RoomPlan]) -> dict[str, dict[str, float]]:
    """Return for each kind of object its hosts, with their counts as shares of the commonest host's count."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for room in rooms:
        for thing in room.things:
            counts[thing.kind][thing.host] += 1
    return {
        kind: {host: round(number / max(found.values()), 3) for host, number in sorted(found.items())}
        for kind, found in sorted(counts.items())
    }


def fit(good: Sequence[RoomPlan], spoilt: Sequence[RoomPlan], *, steps: int = 4_000) -> Calibration:
    """Fit weights that separate good rooms from corrupted ones: logistic regression by projected gradient descent.

    Weights are bounded below by 0. A feature that does not apply to a room is replaced by the mean over all rooms.
    """
    hosts = hosts_in(good)
    names = (*CLUTTER, *PLACEMENT)
    rows = [features_of(room, hosts) for room in (*good, *spoilt)]
    table = np.array([[row.get(name, np.nan) for name in names] for row in rows])  # (rooms, features)
    mean = np.nanmean(table, axis=0)  # (features,)
    table = np.where(np.isnan(table), mean, table) - mean
    truth = np.array([1.0] * len(good) + [0.0] * len(spoilt))  # (rooms,)
    balance = np.where(truth > 0, len(truth) / (2 * len(good)), len(truth) / (2 * len(spoilt)))
    weights, bias = np.ones(len(names)), 0.0
    for _ in range(steps):
        error = balance * (1 / (1 + np.exp(-(table @ weights + bias))) - truth)  # (rooms,)
        weights = np.maximum(0.0, weights - 0.5 * (table.T @ error / len(truth) + 1e-3 * weights))
        bias -= 0.5 * float(error.mean())
    return Calibration(
        {name: round(float(value), 4) for name, value in zip(names, weights, strict=True)}, hosts
    )


def auc(good: FloatArray, spoilt: FloatArray) -> float:
    """Return the probability that a good room scores above a corrupted one; ties count half (Mann and Whitney 1947)."""
    above = (good[:, None] > spoilt[None, :]).mean()
    return float(above + (good[:, None] == spoilt[None, :]).mean() / 2)


def _bumps(items: Sequence[RoomBox], at: int) -> bool:
    """True if the item overlaps another one. Seats at tables and furniture on carpets do not count."""
    return any(_overlap(items[at], other) for number, other in enumerate(items) if number != at)


def _overlap(one: RoomBox, other: RoomBox) -> bool:
    if FLOOR in (one.host, other.host) and ({one.kind, other.kind} & (SEATS | {"carpet"})):
        return False
    if min(one.high_m, other.high_m) - max(one.low_m, other.low_m) <= SLACK_M:
        return False
    return _gap_m(one, other) < -SLACK_M


def _gap_m(one: RoomBox, other: RoomBox) -> float:
    """Return the horizontal distance of two boxes along the room's axes; negative for the depth of an overlap."""
    gaps = [
        abs(a - b) - c - d
        for a, b, c, d in zip(one.center_m, other.center_m, one.reach_m, other.reach_m, strict=True)
    ]
    return math.hypot(*(max(0.0, gap) for gap in gaps)) if max(gaps) > 0 else max(gaps)


def _wall_gap_m(item: RoomBox, plan: RoomPlan) -> float:
    """Return the distance from the box to the nearest edge of the room."""
    (x, y), (a, b) = item.center_m, item.reach_m
    return min(x - a - plan.low_m[0], plan.high_m[0] - x - a, y - b - plan.low_m[1], plan.high_m[1] - y - b)


def _is_within(item: RoomBox, plan: RoomPlan) -> bool:
    return _wall_gap_m(item, plan) >= -5 * SLACK_M


SHIFT_M: Final = 0.4
TURN_RAD: Final = math.radians(15)
SWAPPED: Final = 0.7
"""Share of a room's small objects that change places."""


def shifted(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Move and turn each piece a little at random, together with its small objects."""
    moves = [tuple(float(step) for step in rng.normal(0.0, SHIFT_M, 2)) for _ in room.pieces]
    turned = [
        replace(_moved(item, move), tilt_rad=item.tilt_rad + float(rng.normal(0.0, TURN_RAD)))
        for item, move in zip(room.pieces, moves, strict=True)
    ]
    return replace(room, pieces=tuple(turned), things=_carried(room, moves))


def swapped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Swap the places of small objects, independent of their hosts."""
    chosen = [at for at in range(len(room.things)) if rng.random() < SWAPPED]
    things, carried = list(room.things), list(room.carried)
    for at, other in zip(chosen, rng.permutation(chosen) if chosen else (), strict=True):
        place, thing = room.things[int(other)], room.things[at]
        things[at] = replace(
            thing,
            center_m=place.center_m,
            low_m=place.low_m,
            high_m=place.low_m + thing.high_m - thing.low_m,
            host=place.host,
        )
        carried[at] = room.carried[int(other)]
    return replace(room, things=tuple(things), carried=tuple(carried))


def dropped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Put each piece anywhere in the room, perhaps turned by a quarter, together with its small objects."""
    moves = []
    for item in room.pieces:
        x, y = (float(rng.uniform(low, high)) for low, high in zip(room.low_m, room.high_m, strict=True))
        moves.append((x - item.center_m[0], y - item.center_m[1]))
    pieces = [
        replace(_moved(item, move), half_m=item.half_m[::-1] if rng.random() < 0.5 else item.half_m)
        for item, move in zip(room.pieces, moves, strict=True)
    ]
    return replace(room, pieces=tuple(pieces), things=_carried(room, moves))


SPOILERS: Final = {"shifted": shifted, "swapped": swapped, "dropped": dropped}


def _carried(room: RoomPlan, moves: Sequence[tuple[float, ...]]) -> tuple[RoomBox, ...]:
    return tuple(
        _moved(thing, moves[bearer]) if bearer >= 0 else thing
        for thing, bearer in zip(room.things, room.carried, strict=True)
    )


def _moved(item: RoomBox, move: tuple[float, ...]) -> RoomBox:
    return replace(item, center_m=(item.center_m[0] + move[0], item.center_m[1] + move[1]))


FEWEST_PIECES: Final = 3
"""Least number of pieces of furniture in a hand-made room that is used."""
AUC_GOAL: Final = 0.8
SPLITS: Final = 10
"""Random halvings of the rooms that the held-out AUC is averaged over: a single one depends on luck."""


def evaluate_aesthetics(rooms_file: Path, seed: int) -> tuple[EvaluationFigures, Calibration]:
    """Measure how well fitted scores separate held-out rooms; return also the calibration fitted to all rooms.

    Raises EvaluationError.
    """
    rooms = [room for room in read_rooms(rooms_file) if len(room.pieces) >= FEWEST_PIECES]
    if len(rooms) < 4:
        raise EvaluationError(f"{rooms_file} holds {len(rooms)} rooms with furniture: expected 4 or more")
    rng = np.random.default_rng(seed)
    found: dict[str, list[float]] = {name: [] for name in ("auc", *SPOILERS)}
    good, bad = [], []
    for _ in range(SPLITS):
        order = [rooms[int(at)] for at in rng.permutation(len(rooms))]
        half = len(order) // 2
        calibration = fit(order[:half], _spoilt(order[:half], rng))
        real = _totals(order[half:], calibration)
        spoilt = {
            name: _totals([spoil(room, rng) for room in order[half:]], calibration)
            for name, spoil in SPOILERS.items()
        }
        for name, totals in spoilt.items():
            found[name].append(auc(real, totals))
        everything = np.concatenate([*spoilt.values()])
        found["auc"].append(auc(real, everything))
        good.append(real.mean())
        bad.append(everything.mean())
    n = SPLITS * (len(rooms) - len(rooms) // 2)
    figures = (
        Figure("aesthetics_auc", float(np.mean(found["auc"])), "", Better.HIGHER, n, AUC_GOAL),
        *(
            Figure(f"aesthetics_auc {name}", float(np.mean(found[name])), "", Better.NEITHER, n)
            for name in SPOILERS
        ),
        Figure("aesthetics hand-made", float(np.mean(good)), "of 10", Better.NEITHER, n),
        Figure("aesthetics spoilt", float(np.mean(bad)), "of 10", Better.NEITHER, 3 * n),
    )
    conditions = {"rooms": len(rooms), "halvings": SPLITS, "seed": seed}
    return EvaluationFigures("aesthetics", conditions, figures), fit(rooms, _spoilt(rooms, rng))


def _spoilt(rooms: Sequence[RoomPlan], rng: np.random.Generator) -> list[RoomPlan]:
    return [spoil(room, rng) for spoil in SPOILERS.values() for room in rooms]


def _totals(
    rooms: Sequence[RoomPlan], calibration: Calibration
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([score_room(room, calibration) for room in rooms])
