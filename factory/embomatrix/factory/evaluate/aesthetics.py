"""Aesthetics score of the objects that a layout adds to a room, from 0 to 10, fitted to hand-made rooms.

The score follows the paper's rubric. Correspondence gives 2 points, since every finished layout has all of a task's objects.
Clutter and placement give up to 4 points each. Their parts compare properties of each added object, such as its distance from
the wall, with the same properties in hand-made rooms and in corrupted copies of them (naive Bayes: a property gives the
logarithm of the ratio of its frequencies). A logistic function turns each part into a number between 0 and 1.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.evaluate.room_plans import RoomBox, RoomPlan
from embomatrix.factory.evaluate.spoilers import put_at

FloatArray = NDArray[np.float64]

SEATS: Final = frozenset({"chair", "stool", "taboret", "bar_stool"})
TABLES: Final = frozenset({"dining_table", "desk", "counter_top", "bar", "coffee_table", "side_table"})
OBLONG: Final = 1.25
"""Least ratio of the sides of a piece whose long side has a direction."""
TOUCH_M: Final = 0.02
"""Least common height of two boxes that can collide."""
FAR_M: Final = 9.0
"""Distance to a neighbour that does not exist."""
FILE: Final = "aesthetics.json"


class Property(StrEnum):
    """Property of an added object. All but `USUAL` are binned numbers."""

    APART = "apart"  # distance to the next piece of furniture
    CLEAR = "clear"  # distance to built-in furniture
    WITHIN = "within"  # distance to the nearest wall, negative for the depth in it
    WALL = "wall"  # the same in finer steps
    ALONG = "along"  # 1 if the long side is parallel to the nearest wall
    STRAIGHT = "straight"  # angle of furniture to the room's axes
    SEATED = "seated"  # distance of a seat to its table
    COVERED = "covered"  # share of a small object's area that another one overlaps
    SUNK = "sunk"  # share of its area inside furniture that is not its host
    OVERHANG = "overhang"  # share of its area beyond its host
    SQUARE = "square"  # angle of a small object to the room's axes
    EDGE = "edge"  # distance to the edge of its host
    USUAL = "usual"  # fitness of all hosts, compared with chance


_ANGLES: Final = (math.radians(2), math.radians(10))
_GAPS_M: Final = (-0.3, -0.1, -TOUCH_M, 0.05, 0.2)
EDGES: Final[Mapping[Property, tuple[float, ...]]] = {
    Property.APART: _GAPS_M,
    Property.CLEAR: _GAPS_M,
    Property.WITHIN: (-0.1,),
    Property.WALL: (-0.1, 0.05, 0.15, 0.3, 0.6, 1.2),
    Property.ALONG: (0.5,),
    Property.STRAIGHT: _ANGLES,
    Property.SEATED: (-0.2, 0.0, 0.3, 0.6, 1.0),
    Property.COVERED: (0.002, 0.05, 0.2, 0.5),
    Property.SUNK: (0.02, 0.1, 0.3, 0.6),
    Property.OVERHANG: (0.001, 0.05, 0.2, 0.5),
    Property.SQUARE: _ANGLES,
    Property.EDGE: (-0.05, 0.0, 0.05, 0.1, 0.2, 0.4),
}
"""Upper limits of all bins but the last."""
BY_KIND: Final = frozenset({Property.WALL, Property.ALONG, Property.STRAIGHT, Property.SQUARE})
"""Properties whose frequencies differ between kinds of objects: beds stand at walls, coffee tables do not."""


class ScorePart(StrEnum):
    """Part of the score."""

    FURNITURE_APART = "furniture_apart"
    THINGS_APART = "things_apart"
    FURNITURE_PLACED = "furniture_placed"
    THINGS_SQUARE = "things_square"
    HOSTS_USUAL = "hosts_usual"


PROPERTIES: Final[Mapping[ScorePart, tuple[Property, ...]]] = {
    ScorePart.FURNITURE_APART: (Property.APART, Property.CLEAR, Property.WITHIN),
    ScorePart.THINGS_APART: (Property.COVERED, Property.SUNK, Property.OVERHANG),
    ScorePart.FURNITURE_PLACED: (Property.WALL, Property.ALONG, Property.STRAIGHT, Property.SEATED),
    ScorePart.THINGS_SQUARE: (Property.SQUARE, Property.EDGE),
    ScorePart.HOSTS_USUAL: (Property.USUAL,),
}
CLUTTER: Final[Mapping[ScorePart, float]] = {ScorePart.FURNITURE_APART: 1.0, ScorePart.THINGS_APART: 1.0}
PLACEMENT: Final[Mapping[ScorePart, float]] = {
    ScorePart.FURNITURE_PLACED: 0.3,
    ScorePart.THINGS_SQUARE: 0.3,
    ScorePart.HOSTS_USUAL: 1.0,
}
"""Weights of the parts in the two criteria of the rubric, chosen so that no corruption escapes the score (ADR 0093)."""
LENIENCE: Final = 1.0
"""Logarithm of the odds that objects are well placed before any evidence: layouts are meant to be good."""

KIND_PRIOR: Final = 6.0
"""Observations of all kinds that a kind's own frequencies are mixed with."""
HOST_PRIOR: Final = 4.0
"""The same for hosts."""
BIN_PRIOR: Final = 2.0
"""Observations added to each bin."""
RARE: Final = 0.5
"""Observations added to each host."""
Binned = tuple[Property, str, int]
"""Bin of one property of an object of a kind."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Fitted tables and weights.

    ``real`` counts the bins of each property in hand-made rooms by kind, ``spoilt`` over all kinds in copies whose
    corruption changes the property.
    ``hosts`` counts the hosts of each kind. ``weights`` are those of the properties in their parts, none below 0.
    """

    real: Mapping[Property, Mapping[str, Sequence[float]]]
    spoilt: Mapping[Property, Sequence[float]]
    hosts: Mapping[str, Mapping[str, float]]
    weights: Mapping[ScorePart, Mapping[Property, float]]
    bias: Mapping[ScorePart, float]

    @staticmethod
    def load() -> Calibration:
        """Return the packaged calibration; NOTICE.md names the rooms that it was fitted to."""
        path = resources.files("embomatrix.factory.evaluate") / FILE
        value = json.loads(path.read_text(encoding="utf-8"))
        return Calibration(
            real={Property(name): kinds for name, kinds in value["real"].items()},
            spoilt={Property(name): counts for name, counts in value["spoilt"].items()},
            hosts=value["hosts"],
            weights={
                ScorePart(part): {Property(name): weight for name, weight in weights.items()}
                for part, weights in value["weights"].items()
            },
            bias={ScorePart(part): bias for part, bias in value["bias"].items()},
        )


def score_room(plan: RoomPlan, calibration: Calibration) -> float | None:
    """Return the score of a room's added objects, of which all requested ones are present; None if there are none."""
    if not plan.added_pieces and not plan.added_things:
        return None
    return score_of(parts_of(plan, calibration))


def score_of(parts: Mapping[ScorePart, float]) -> float:
    """Return the score from the parts that apply to a room; there must be one of clutter and one of placement."""
    return 2 + 4 * _weighted(parts, CLUTTER) + 4 * _weighted(parts, PLACEMENT)


def _weighted(parts: Mapping[ScorePart, float], weights: Mapping[ScorePart, float]) -> float:
    """Return the weighted mean of the parts that apply to the room."""
    whole = sum(weight for part, weight in weights.items() if part in parts)
    return sum(weight * parts[part] for part, weight in weights.items() if part in parts) / whole


def parts_of(plan: RoomPlan, calibration: Calibration) -> dict[ScorePart, float]:
    """Return the parts that apply to the room's added objects, in [0, 1]."""
    return parts_from(RoomObservation.of(plan).evidence(EvidenceTables(calibration)), calibration)


def parts_from(evidence: Mapping[Property, float], calibration: Calibration) -> dict[ScorePart, float]:
    """Return the parts for which there is evidence, in [0, 1]."""
    return {
        part: 1 / (1 + math.exp(-_logit(evidence, calibration.weights[part], calibration.bias[part])))
        for part, names in PROPERTIES.items()
        if any(name in evidence for name in names)
    }


def _logit(evidence: Mapping[Property, float], weights: Mapping[Property, float], bias: float) -> float:
    return LENIENCE + bias + sum(weight * evidence.get(name, 0.0) for name, weight in weights.items())


class EvidenceTables:
    """Logarithms of frequency ratios, hand-made to corrupted, computed from a calibration's counts."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._all = {name: np.sum([*kinds.values()], axis=0) for name, kinds in calibration.real.items()}
        self._ratios: dict[tuple[Property, str], tuple[float, ...]] = {}
        self._host_counts: defaultdict[str, float] = defaultdict(float)
        for hosts in calibration.hosts.values():
            for host, count in hosts.items():
                self._host_counts[host] += count
        self._whole = sum(self._host_counts.values())

    def ratios(self, name: Property, kind: str) -> tuple[float, ...]:
        """Return a property's evidence by bin. Kinds that the hand-made rooms lack get that of all kinds."""
        key = (name, kind if name in BY_KIND else "")
        if key not in self._ratios:
            bins = len(EDGES[name]) + 1
            real = _shares(self._all.get(name, np.zeros(bins)))
            counts = np.asarray(self._calibration.real.get(name, {}).get(key[1], np.zeros(bins)))
            real = (counts + KIND_PRIOR * real) / (counts.sum() + KIND_PRIOR)
            spoilt = _shares(np.asarray(self._calibration.spoilt.get(name, np.zeros(bins))))
            self._ratios[key] = tuple(np.log(real / spoilt).tolist())
        return self._ratios[key]

    def host_fit(self, kind: str, host: str) -> float:
        """Return the pointwise mutual information of a kind and a host; 0 for kinds that the hand-made rooms lack."""
        found = self._calibration.hosts.get(kind, {})
        # The number of hosts bounds the mass that unseen ones get.
        base = (self._host_counts.get(host, 0.0) + RARE) / (self._whole + RARE * (len(self._host_counts) + 1))
        share = (found.get(host, 0.0) + HOST_PRIOR * base) / (sum(found.values()) + HOST_PRIOR)
        return math.log(share / base)


def _shares(counts: FloatArray) -> FloatArray:
    shares: FloatArray = (counts + BIN_PRIOR) / (counts.sum() + BIN_PRIOR * len(counts))
    return shares


@dataclass(frozen=True, slots=True)
class RoomObservation:
    """Facts about a room that the score needs, before any table: bins of properties, and hosts.

    Row i of ``overhangs`` has the bins of overhang of added small object i at all places of the room, -1 without a host;
    ``chosen[i]`` is its own place.
    """

    bins: tuple[Binned, ...]
    kinds: tuple[str, ...]
    chosen: tuple[int, ...]
    hosts: tuple[str, ...]
    overhangs: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(plan: RoomPlan) -> RoomObservation:
        """Observe a room. Its places are those of its small objects."""
        bearers = plan.bearers
        places = [
            (place, bearers[hosts[0]] if hosts else None)
            for place, hosts in zip(plan.things, plan.carried, strict=True)
        ]
        things = [plan.things[at] for at in plan.added_things]
        return RoomObservation(
            bins=tuple(_binned(plan)),
            kinds=tuple(thing.kind for thing in things),
            chosen=plan.added_things,
            hosts=tuple(place.host for place in plan.things),
            overhangs=tuple(
                tuple(_overhang_bin(put_at(thing, place), host) for place, host in places) for thing in things
            ),
        )

    def evidence(self, tables: EvidenceTables) -> dict[Property, float]:
        """Return the mean evidence of each property over the added objects that have it, and the fitness of their hosts."""
        found: defaultdict[Property, list[float]] = defaultdict(list)
        for name, kind, at in self.bins:
            found[name].append(tables.ratios(name, kind)[at])
        evidence = {name: sum(values) / len(values) for name, values in found.items()}
        if self.chosen:
            evidence[Property.USUAL] = self._hosts_above_chance(tables)
        return evidence

    def _hosts_above_chance(self, tables: EvidenceTables) -> float:
        """Return the logarithm of the odds that the small objects are at their places, and not at random ones of the room.

        An object that is at home anywhere, or in a room with one kind of host, gives no evidence.
        """
        overhang = (*tables.ratios(Property.OVERHANG, ""), 0.0)  # the last one for -1
        total = 0.0
        for kind, own, row in zip(self.kinds, self.chosen, self.overhangs, strict=True):
            fit = {host: tables.host_fit(kind, host) for host in set(self.hosts)}
            fits = [fit[host] + overhang[at] for host, at in zip(self.hosts, row, strict=True)]
            total += fits[own] - math.log(sum(map(math.exp, fits)) / len(fits))
        return total


def _overhang_bin(thing: RoomBox, host: RoomBox | None) -> int:
    return -1 if host is None else bisect_left(EDGES[Property.OVERHANG], _share_beyond(thing, host))


def _binned(plan: RoomPlan) -> Iterator[Binned]:
    """Yield the bin of each property of each added object."""
    for at in plan.added_pieces:
        for name, value in _piece_properties(plan, at):
            yield name, plan.pieces[at].kind, bisect_left(EDGES[name], value)
    for at in plan.added_things:
        for name, value in _thing_properties(plan, at):
            yield name, plan.things[at].kind, bisect_left(EDGES[name], value)


def _piece_properties(plan: RoomPlan, at: int) -> Iterator[tuple[Property, float]]:
    piece = plan.pieces[at]
    others = [other for number, other in enumerate(plan.pieces) if number != at]
    walls = _wall_gaps_m(piece, plan)
    # Seats stand under tables and are pulled out: their boxes overlap.
    solid = [other for other in others if not {piece.kind, other.kind} & SEATS]
    yield Property.APART, _nearest_m(piece, solid)
    yield Property.CLEAR, _nearest_m(piece, plan.built_in)
    yield Property.WITHIN, min(walls)
    yield Property.WALL, min(walls)
    yield Property.STRAIGHT, abs(piece.tilt_rad)
    if piece.kind in SEATS:
        tables = [other for other in (*others, *plan.built_in) if other.kind in TABLES]
        yield Property.SEATED, min((_gap_m(piece, table) for table in tables), default=FAR_M)
    if max(piece.half_m) > OBLONG * min(piece.half_m):
        at_y_wall = walls.index(min(walls)) >= 2
        yield Property.ALONG, float(at_y_wall == (piece.reach_m[0] > piece.reach_m[1]))


def _thing_properties(plan: RoomPlan, at: int) -> Iterator[tuple[Property, float]]:
    thing, hosts = plan.things[at], plan.carried[at]
    bearers = plan.bearers
    others = [other for number, other in enumerate(plan.things) if number != at]
    furniture = [other for number, other in enumerate(bearers) if number not in hosts and other != thing]
    # An object lies in its host's box, and so does whatever the host holds.
    held = [other for other in others if all(other != bearers[host] for host in hosts)]
    yield Property.COVERED, _covered(thing, held)
    yield Property.SUNK, _covered(thing, furniture)
    yield Property.SQUARE, abs(thing.tilt_rad)
    if hosts:
        host = bearers[hosts[0]]
        yield Property.OVERHANG, _share_beyond(thing, host)
        yield (
            Property.EDGE,
            min(
                outer - abs(a - b) - inner
                for a, b, inner, outer in zip(
                    thing.center_m, host.center_m, thing.reach_m, host.reach_m, strict=True
                )
            ),
        )


def _nearest_m(item: RoomBox, others: Iterable[RoomBox]) -> float:
    """Return the distance to the next box at the same height."""
    return min(
        (_gap_m(item, other) for other in others if _common_height_m(item, other) > TOUCH_M), default=FAR_M
    )


def _covered(item: RoomBox, others: Iterable[RoomBox]) -> float:
    """Return the greatest share of the smaller of two boxes' areas that they have in common, over boxes at one height."""
    found = 0.0
    for other in others:
        if _common_height_m(item, other) > TOUCH_M / 4:
            smaller = min(item.reach_m[0] * item.reach_m[1], other.reach_m[0] * other.reach_m[1])
            found = max(found, _common_area_m2(item, other) / max(1e-6, 4 * smaller))
    return found


def _share_beyond(item: RoomBox, host: RoomBox) -> float:
    """Return the share of a box's area that is beyond its host."""
    return 1 - _common_area_m2(item, host) / max(1e-9, 4 * item.reach_m[0] * item.reach_m[1])


def _common_area_m2(one: RoomBox, other: RoomBox) -> float:
    sides = [
        max(0.0, min(a + c, b + d) - max(a - c, b - d))
        for a, b, c, d in zip(one.center_m, other.center_m, one.reach_m, other.reach_m, strict=True)
    ]
    return sides[0] * sides[1]


def _common_height_m(one: RoomBox, other: RoomBox) -> float:
    return min(one.high_m, other.high_m) - max(one.low_m, other.low_m)


def _gap_m(one: RoomBox, other: RoomBox) -> float:
    """Return the horizontal distance of two boxes along the room's axes; negative for the depth of an overlap."""
    gaps = [
        abs(a - b) - c - d
        for a, b, c, d in zip(one.center_m, other.center_m, one.reach_m, other.reach_m, strict=True)
    ]
    return math.hypot(*(max(0.0, gap) for gap in gaps)) if max(gaps) > 0 else max(gaps)


def _wall_gaps_m(item: RoomBox, plan: RoomPlan) -> tuple[float, float, float, float]:
    """Return the distances from the box to the room's edges: both across x, then both across y."""
    (x, y), (a, b) = item.center_m, item.reach_m
    return x - a - plan.low_m[0], plan.high_m[0] - x - a, y - b - plan.low_m[1], plan.high_m[1] - y - b
