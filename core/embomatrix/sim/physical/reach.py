"""How the arm gets the tool along a short way: postures in closed form, judged by joint limits and by what is around.

Nothing is searched at random where geometry answers: bases, heights of the lift and angles of the last joint are tried
together, and of what is left the most comfortable way that is free is taken.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.roadmap import way_between
from embomatrix.sim.physical.space import Boxes, Struck, struck
from embomatrix.sim.robot_dimensions import LIFT_M, SHOULDER_LOW_M
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from embomatrix.world.geometry import FloatArray

    BoolArray = NDArray[np.bool_]

OVER_WRIST_M: Final = (0.0, 0.2, 0.4, -0.2)
"""Heights of the shoulder over the wrist that are tried."""
LIFT_SPARE_M: Final = 0.08
"""The lift keeps this much travel to raise what the hand takes."""
LAST_RAD: Final = np.array([0.785, -0.785, 2.3, -2.3, 0.0, 1.57, -1.57])
ALIKE_RAD: Final = 0.5
JUMP_RAD: Final = 1.3
"""Between two waypoints of a way no joint turns further."""
LOOKED_AT: Final = (0, 160, 640)
"""Of all solutions, this many of the most comfortable ones are compared with what is around, and more where none is free."""
RANK: Final = 0.2
"""What a place further down the list of tracks weighs against the strain of joints."""
FOLLOWED: Final = 40
"""Solutions whose ways are worked out at once: one way costs nearly as much as many do."""
LOTS: Final = (0, 4, FOLLOWED)
"""Of those, the first few are compared with what is around before the others: they often do."""
OFFERED: Final = 3
"""Ways of one batch that are offered."""
BATCH: Final = 12
"""Ways that are looked at together."""
AIR_M: Final = 0.012
"""Distance that the arm keeps from things."""
TOUCH_M: Final = -0.003
"""How deep balls of the hand, or of what it holds, may seem to be in things: they are a little larger than the truth."""
SAMPLED: Final = np.array([0.06, 0.06, 0.1, 0.06, 0.1, 0.1, 0.12, 0.12, 0.25, 0.25, 0.4])
"""Metres, and radians, of each number of a posture between two that are looked at."""
MOST_SAMPLES: Final = 36
LEVEL: Final = 0.93
"""Cosine of the steepest tilt, 21 degrees, at which what lies in a bowl stays there."""
SCATTER: Final = 0
"""Seed of the postures that are scattered."""
DRAWS: Final = 24
"""Scattered postures by which the arm may find its way to one place of work."""


@dataclass(frozen=True, slots=True)
class HeldGeometry:
    """Balls of what the hand holds, in the tool's frame: centres (k, 3), radii (k,).

    ``up``, (3,), is the way up in that frame where something lies in what is held, so that it must stay level.
    """

    centres: FloatArray
    radii: FloatArray
    up: FloatArray | None = None

    def placed(self, postures: FloatArray) -> FloatArray:
        """Centres in the world, (n, k, 3)."""
        rotation, position = body.tools(postures)
        return np.asarray(position[:, None] + self.centres @ rotation.transpose(0, 2, 1))

    def is_level(self, postures: FloatArray) -> BoolArray:
        """Whether nothing falls out of what is held, (n,)."""
        if self.up is None:
            return np.ones(len(postures), dtype=np.bool_)
        rotation, _ = body.tools(postures)
        return np.asarray(rotation[:, 2] @ self.up > LEVEL)


@dataclass(frozen=True, slots=True)
class Track:
    """A way of the tool: rotations (w, 3, 3) and positions (w, 3) in the world.

    ``loaded`` marks the waypoints, (w,), at which the hand holds what it holds. ``key`` is the waypoint that matters most.
    """

    rotation: FloatArray
    position: FloatArray
    loaded: BoolArray
    key: int

    @property
    def key_pose(self) -> Pose:
        """Where the tool is at the key, in the world."""
        return Pose.from_rotation(tuple(self.position[self.key].tolist()), self.rotation[self.key])


@dataclass(frozen=True, slots=True)
class Way:
    """Postures (w, 11) that follow a track, and the track's number among those that were offered."""

    postures: FloatArray
    number: int
    track: Track


class ArmReach:
    """Ways of one hand, empty or not, among boxes."""

    def __init__(
        self,
        boxes: Boxes,
        at_work: Boxes,
        held: HeldGeometry | None = None,
        also: Callable[[FloatArray], bool] | None = None,
    ) -> None:
        """``at_work`` are the boxes without those that the hand may touch at the end of its way.

        ``also`` has a say in which ways, (w, 11), are free.
        """
        self._also = also
        self._boxes = boxes
        self._standing = boxes.without(("floor",))
        self._at_work = at_work
        self._held = held
        self._struck: Struck | None = None

    @property
    def hindrance(self) -> str:
        """Owner of the box that barred the last way that was not free; "" when none did."""
        return self._struck.owner if self._struck is not None else ""

    def ways(self, tracks: Iterable[Track], places: Sequence[FloatArray]) -> Iterator[Way]:
        """Free ways along any of the tracks, the preferred tracks first, from any base of groups of them, (b, 3) each.

        A later group is looked at for what the ones before it do not reach, and a track is asked for when its turn comes.
        """
        rest = iter(tracks)
        start = 0
        while batch := list(itertools.islice(rest, BATCH)):
            for bases in places:
                yield from self._some(batch, start, bases)
            start += len(batch)

    def transit(
        self,
        start: FloatArray,
        end: FloatArray,
        *,
        loaded: bool,
        draws: int = DRAWS,
    ) -> FloatArray | None:
        """Postures (w, 11) that lead from one to another without touching anything, None when none are found.

        The arm moves where the base is at the start; then the base drives to where it is at the end. Straight on, or by way
        of what so many scattered postures lead to.
        """
        held = self._held if loaded else None
        ready = np.concatenate([start[:3], end[3:]])
        if not self._is_free(_between(ready, end), held):
            return None

        def free_up_to(one: FloatArray, other: FloatArray) -> FloatArray:
            between = _between(one, other)[1:]
            free = self._free(between[:-1], self._boxes, held, AIR_M)
            # Start and end are where the robot is and where it must be, whatever is near them.
            last = bool(np.array_equal(other, ready) or np.array_equal(other, start))
            if free.all() and (last or self._free(other[None], self._boxes, held, AIR_M)[0]):
                return other
            reached = int(free.argmin()) if not free.all() else len(free)
            return between[reached - 1] if reached else one

        drawn = _drawn(start, draws, level=held is not None and held.up is not None)
        drawn[:1] = (start + ready) / 2
        way = way_between(start, ready, drawn, SAMPLED, free_up_to)
        return None if way is None else np.concatenate([way, end[None]])

    def drives(self, start: FloatArray, end: FloatArray, *, loaded: bool) -> bool:
        """Whether the base can drive straight from one posture to another with the arm as it is."""
        line = _between(start, end)
        trunk, radii = body.trunk_balls(line)
        hit = struck(self._standing, trunk, radii, 0.0)
        return not hit.any() and self._is_free(line, self._held if loaded else None)

    def _is_free(self, postures: FloatArray, held: HeldGeometry | None) -> bool:
        """Whether all but the first and the last posture keep clear: these are where the robot is, and where it must be."""
        return bool(self._free(postures[1:-1], self._boxes, held, AIR_M).all())

    def _some(self, tracks: Sequence[Track], first: int, bases: FloatArray) -> list[Way]:
        """Free ways along a batch of tracks, best first. ``first`` is the number of its first track."""
        track, base, lift, last = _combinations(tracks, bases)
        key_rotation = np.stack([one.rotation[one.key] for one in tracks])
        key_position = np.stack([one.position[one.key] for one in tracks])
        found = body.solve(key_rotation[track], key_position[track], bases[base], lift, last)
        rows, branches = np.nonzero(~np.isnan(found[:, :, -1]))
        if not len(rows):
            return []
        comfort = arm.strain(found[rows, branches][:, body.ARM]) + RANK * track[rows]
        for fore, end in itertools.pairwise(LOOKED_AT):
            best = _best_of_each(base[rows], comfort, _share(fore, bases), _share(end, bases))
            some = best[self._free(found[rows[best], branches[best]], self._at_work, None, TOUCH_M)]
            row = rows[some]
            ways = self._along(
                [tracks[number] for number in track[row].tolist()],
                [first + number for number in track[row].tolist()],
                (bases[base[row]], lift[row], last[row], branches[some]),
            )
            if ways:
                return ways
        return []

    def _along(
        self,
        tracks: Sequence[Track],
        numbers: Sequence[int],
        starts: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    ) -> list[Way]:
        """The first free ways, each unlike those before it, from bases, lifts, last angles and branches along tracks."""
        ways: list[Way] = []
        for start in range(0, len(tracks), FOLLOWED):
            some = slice(start, start + FOLLOWED)
            followed = _followed(tracks[some], *(values[some] for values in starts))
            found = [
                Way(postures, number, track)
                for number, track, postures in zip(numbers[some], tracks[some], followed, strict=True)
                if postures is not None
            ]
            for first, last in itertools.pairwise(LOTS):
                self._choose(found[first:last], ways)
                if len(ways) == OFFERED:
                    return ways
        return ways

    def _choose(self, offered: Sequence[Way], ways: list[Way]) -> None:
        """Add to some ways the free ones of others that are unlike them, until there are enough."""
        unlike = [way for way in offered if not _is_known(way, ways)]
        if not unlike:
            return
        for way, (free, hit) in zip(unlike, self._looked_at(unlike), strict=True):
            if _is_known(way, ways):
                continue
            if free and (self._also is None or self._also(way.postures)):
                ways.append(way)
                if len(ways) == OFFERED:
                    return
            self._struck = hit or self._struck

    def _looked_at(self, ways: Sequence[Way]) -> list[tuple[bool, Struck | None]]:
        """Whether ways are free, and what bars those that aren't as far as it isn't the robot itself."""
        postures = np.concatenate([way.postures for way in ways])
        loaded = np.concatenate([way.track.loaded for way in ways])
        number = np.repeat(np.arange(len(ways)), [len(way.postures) for way in ways])
        trunk, trunk_radii = body.trunk_balls(np.stack([way.postures[0] for way in ways]))
        free = ~struck(self._standing, trunk, trunk_radii, TOUCH_M)
        hits: list[Struck | None] = [None] * len(ways)
        for mask, held in ((~loaded, None), (loaded, self._held)):
            rows = np.flatnonzero(mask & free[number])
            if not len(rows):
                continue
            clear, seen = self._compared(postures[rows], self._at_work, held, TOUCH_M)
            if seen is not None:
                hit = np.flatnonzero(seen.rows)
                for way, row in zip(*np.unique(number[rows[hit]], return_index=True), strict=True):
                    hits[way] = seen.only(hit[row])
            free[number[rows[~clear]]] = False
        return list(zip(free.tolist(), hits, strict=True))

    def _free(
        self, postures: FloatArray, boxes: Boxes, held: HeldGeometry | None, margin_m: float
    ) -> BoolArray:
        """Whether arm and load keep a margin from the boxes and from the robot's own trunk, shape (n,)."""
        if not len(postures):
            return np.zeros(0, dtype=np.bool_)
        free, seen = self._compared(postures, boxes, held, margin_m)
        if seen is not None:
            self._struck = seen.only(int(seen.rows.argmax()))
        return free

    def _compared(
        self, postures: FloatArray, boxes: Boxes, held: HeldGeometry | None, margin_m: float
    ) -> tuple[BoolArray, Struck | None]:
        """As ``_free`` of at least one posture, with those that boxes bar, if there are any."""
        centres, radii = body.balls(postures), body.RADII
        if held is not None:
            centres = np.concatenate([centres, held.placed(postures)], axis=1)
            radii = np.concatenate([radii, held.radii])
        widest = float(radii.max()) + 0.05
        close = boxes.near(centres.min(axis=(0, 1)) - widest, centres.max(axis=(0, 1)) + widest)
        barred = struck(close, centres, radii, margin_m)
        free = ~barred
        free[free] = ~body.strikes_itself(postures[free], centres[free], radii)
        if held is not None and held.up is not None:
            free[free] = held.is_level(postures[free])
        return np.asarray(free), Struck(close, centres, radii, margin_m, barred) if barred.any() else None


def _share(most: int, bases: FloatArray) -> int:
    """How many of a number of solutions each base gets."""
    return max(4, most // len(bases)) if most else 0


def _best_of_each(base: FloatArray, cost: FloatArray, first: int, end: int) -> FloatArray:
    """Numbers of the cheapest solutions for each base, from the first to before the end, the cheapest first."""
    order = np.argsort(cost, kind="stable")
    kept = [order[base[order] == number][first:end] for number in np.unique(base)]
    chosen = np.concatenate(kept)
    return np.asarray(chosen[np.argsort(cost[chosen], kind="stable")])


def _is_known(way: Way, ways: Iterable[Way]) -> bool:
    """Whether a way begins like one of others."""
    return any(_alike(way.postures[0], other.postures[0]) for other in ways)


def _alike(one: FloatArray, other: FloatArray) -> bool:
    """Whether two postures differ so little that what bars the one bars the other."""
    return bool(np.abs(one[:2] - other[:2]).max() < 0.1 and np.abs(one[4:] - other[4:]).max() < ALIKE_RAD)


def _combinations(
    tracks: Sequence[Track], bases: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Every track with every base, lift and last angle: numbers within the batch, numbers of bases, lifts, angles."""
    heights = np.array(
        [
            track.position[track.key][2] - track.rotation[track.key][2, 2] * (arm.FLANGE_M + arm.TOOL_M)
            for track in tracks
        ]
    )
    offsets = np.array(OVER_WRIST_M)
    track, base, offset, last = (
        grid.ravel()
        for grid in np.meshgrid(
            np.arange(len(tracks)), np.arange(len(bases)), offsets, LAST_RAD, indexing="ij"
        )
    )
    lift = heights[track] + offset - SHOULDER_LOW_M
    return track, base, np.clip(lift, 0.0, LIFT_M - LIFT_SPARE_M), last


def _followed(
    tracks: Sequence[Track], bases: FloatArray, lifts: FloatArray, last: FloatArray, branches: FloatArray
) -> list[FloatArray | None]:
    """Postures along each of n tracks with base, lift and last joint at rest, None where it leaves the arm's reach or jumps.

    bases: (n, 3), lifts: (n,), last: (n,), branches: (n,).
    """
    counts = np.array([len(track.position) for track in tracks])
    row = np.repeat(np.arange(len(tracks)), counts)
    rotation = np.concatenate([track.rotation for track in tracks])
    position = np.concatenate([track.position for track in tracks])
    found = body.solve(rotation, position, bases[row], lifts[row], last[row])
    chosen = found[np.arange(len(row)), branches[row]]
    ends = np.cumsum(counts)
    parts = [chosen[end - count : end] for count, end in zip(counts.tolist(), ends.tolist(), strict=True)]
    return [
        None
        if np.isnan(part[:, -1]).any() or np.abs(np.diff(part[:, 4:], axis=0)).max(initial=0.0) > JUMP_RAD
        else part
        for part in parts
    ]


def _drawn(start: FloatArray, count: int, *, level: bool) -> FloatArray:
    """Postures, (n, 11), with the base where it is at the start; ``level``: what is held there turned about z alone.

    They are scattered, and always the same: where a way is found in a scene once, it is found there again.
    """
    rng = np.random.default_rng(SCATTER)
    low = np.concatenate([[0.0], arm.LOW_RAD * 0.9])
    high = np.concatenate([[LIFT_M], arm.HIGH_RAD * 0.9])
    drawn = np.tile(start, (count, 1))
    drawn[:, body.LIFT :] = rng.uniform(low, high, (count, len(low)))
    if not level:
        return drawn
    turn = arm.about_z(rng.uniform(-np.pi, np.pi, count)) @ body.tools(start[None])[0]
    ahead = rng.uniform((0.1, -0.4, -0.2), (0.8, 0.4, 0.4), (count, 3))
    ahead[:, 2] += drawn[:, body.LIFT] + SHOULDER_LOW_M
    place = ahead @ arm.about_z(start[None, body.YAW])[0].T + np.array([start[0], start[1], 0.0])
    found = body.solve(turn, place, drawn[:, :3], drawn[:, body.LIFT], rng.choice(LAST_RAD, count))
    rows = found.reshape(-1, body.NUMBERS)
    rows = rows[~np.isnan(rows[:, -1])]
    return rows if len(rows) else drawn[:1]


def _between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Postures from one to another, (n, 11), so close that nothing thin is passed unseen."""
    count = int(np.ceil((np.abs(end - start) / SAMPLED).max())) + 2
    shares = np.linspace(0.0, 1.0, min(count, MOST_SAMPLES))[:, None]
    return np.asarray(start + shares * (end - start))
