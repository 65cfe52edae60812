"""How well a room is laid out, by its geometry: 0 to 10 in the parts of the paper's rubric, weights fitted to hand-made rooms.

Correspondence gives 2 points: the share of what a task asks for that is there, as whoever laid the scene out is told. Clutter
and placement give 4 each: features in [0, 1], weighted. The weights come of a logistic regression that tells hand-made
rooms from the same rooms spoilt (see ``spoiling``); a weight below 0 is none.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy import ndimage

from embomatrix.factory.evaluate.rooms import FLOOR, RoomBox, RoomPlan

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

CELL_M: Final = 0.1
ROBOT_M: Final = 0.2
"""Radius with which free floor is walked through: SceneEval's, after PhyScene."""
WALL_M: Final = 0.15
"""As in the counts of how often furniture of a kind stands at the edge of a room."""
STRAIGHT_RAD: Final = math.radians(2)
SEAT_M: Final = 0.5
"""Between the edge of a seat and that of its table."""
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
"""Share of a host, of the commonest one's, that counts as none."""
REACH_M: Final = (0.2, 1.5)
"""Heights at which the robot's arm works."""
FILE: Final = "aesthetics.json"


@dataclass(frozen=True, slots=True)
class Calibration:
    """``weights`` by feature, none below 0; ``hosts`` are shares of hosts by kind of thing, counted in hand-made rooms."""

    weights: Mapping[str, float]
    hosts: Mapping[str, Mapping[str, float]]

    @staticmethod
    def load() -> Calibration:
        """The one that was fitted to the rooms that the data's notice names."""
        path = resources.files("embomatrix.factory.evaluate") / FILE
        value = json.loads(path.read_text(encoding="utf-8"))
        return Calibration(value["weights"], value["hosts"])


@dataclass(frozen=True, slots=True)
class Score:
    """Points: of 2, of 4 and of 4. ``features`` are those that the room has anything to tell about."""

    correspondence: float
    clutter: float
    placement: float
    features: Mapping[str, float]

    @property
    def total(self) -> float:
        return self.correspondence + self.clutter + self.placement


def score_room(plan: RoomPlan, calibration: Calibration, correspondence: float = 1.0) -> Score:
    """``correspondence`` is the share of what was asked for that is there and holds, 1 where nothing was asked for."""
    features = features_of(plan, calibration.hosts)
    return Score(
        2 * correspondence,
        4 * _weighted(features, CLUTTER, calibration.weights),
        4 * _weighted(features, PLACEMENT, calibration.weights),
        features,
    )


def _weighted(features: Mapping[str, float], names: Sequence[str], weights: Mapping[str, float]) -> float:
    """Weighted mean of the named features that the room has; full marks where it has none."""
    known = [name for name in names if name in features]
    whole = sum(weights[name] for name in known)
    return sum(weights[name] * features[name] for name in known) / whole if whole else 1.0


def features_of(plan: RoomPlan, hosts: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Features in [0, 1], 1 the best; those are left out that the room has nothing for."""
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
    """Of a host: 1 for the commonest one, 0 for one that people never use, the logarithm of its share between."""
    return 1 - math.log(max(share, RAREST)) / math.log(RAREST)


def walkable_share(plan: RoomPlan) -> float:
    """The largest part of the free floor that the robot can drive through, over all of the free floor."""
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
    """How things of a kind are shared among kinds of hosts, by kind: each host's count over that of the commonest one."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for room in rooms:
        for thing in room.things:
            counts[thing.kind][thing.host] += 1
    return {
        kind: {host: round(number / max(found.values()), 3) for host, number in sorted(found.items())}
        for kind, found in sorted(counts.items())
    }


def fit(good: Sequence[RoomPlan], spoilt: Sequence[RoomPlan], *, steps: int = 4_000) -> Calibration:
    """Weights that tell good rooms from spoilt ones: logistic regression by projected gradient descent, no weight below 0.

    A feature that a room has nothing for counts as the mean over all rooms.
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
    """Chance that a good room scores above a spoilt one, a draw counting half: Mann and Whitney 1947."""
    above = (good[:, None] > spoilt[None, :]).mean()
    return float(above + (good[:, None] == spoilt[None, :]).mean() / 2)


def _bumps(items: Sequence[RoomBox], at: int) -> bool:
    """Whether the item is in another one; what is drawn up to a table, or stands on a carpet, is not."""
    return any(_overlap(items[at], other) for number, other in enumerate(items) if number != at)


def _overlap(one: RoomBox, other: RoomBox) -> bool:
    if FLOOR in (one.host, other.host) and ({one.kind, other.kind} & (SEATS | {"carpet"})):
        return False
    if min(one.high_m, other.high_m) - max(one.low_m, other.low_m) <= SLACK_M:
        return False
    return _gap_m(one, other) < -SLACK_M


def _gap_m(one: RoomBox, other: RoomBox) -> float:
    """Distance of the two boxes' shadows on the room's axes; below 0 how deep one is in the other."""
    gaps = [
        abs(a - b) - c - d
        for a, b, c, d in zip(one.center_m, other.center_m, one.reach_m, other.reach_m, strict=True)
    ]
    return math.hypot(*(max(0.0, gap) for gap in gaps)) if max(gaps) > 0 else max(gaps)


def _wall_gap_m(item: RoomBox, plan: RoomPlan) -> float:
    """From the box to the nearest edge of the room."""
    (x, y), (a, b) = item.center_m, item.reach_m
    return min(x - a - plan.low_m[0], plan.high_m[0] - x - a, y - b - plan.low_m[1], plan.high_m[1] - y - b)


def _is_within(item: RoomBox, plan: RoomPlan) -> bool:
    return _wall_gap_m(item, plan) >= -5 * SLACK_M
