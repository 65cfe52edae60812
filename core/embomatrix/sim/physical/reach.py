"""Reach of the arm along a tool path: closed-form postures, judged by joint limits and by obstacles.

Bases, lift heights and angles of the last joint are enumerated together. Of the free paths, the most comfortable is taken.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.engine import FLOOR
from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.rrt import path_between
from embomatrix.sim.physical.space import BallCollision, Boxes, collides
from embomatrix.sim.robot_dimensions import LIFT_M, SHOULDER_LOW_M
from embomatrix.world.geometry import FloatArray, Pose

BoolArray = NDArray[np.bool_]

OVER_WRIST_M: Final = (0.0, 0.2, 0.4, -0.2)
"""Heights of the shoulder over the wrist to try."""
LIFT_SPARE_M: Final = 0.08
"""Travel that the lift keeps to raise a gripped object."""
LAST_RAD: Final = np.array([0.785, -0.785, 2.3, -2.3, 0.0, 1.57, -1.57])
ALIKE_RAD: Final = 0.5
JUMP_RAD: Final = 1.3
"""Largest rotation of a joint between two waypoints."""
EXAMINED: Final = (0, 160, 640)
"""Numbers of the most comfortable solutions to check against obstacles; more if none is free."""
RANK: Final = 0.2
"""Weight of the rank of a tool path against joint strain."""
FOLLOWED: Final = 40
"""Solutions whose paths are computed at once: one path costs nearly as much as many."""
CHECK_LOTS: Final = (0, 4, FOLLOWED)
"""Bounds of the two lots in which paths are checked against obstacles. The first lot is often enough."""
PATHS_RETURNED: Final = 3
"""Paths of one batch to return."""
BATCH: Final = 12
"""Tool paths to examine together."""
CLEARANCE_M: Final = 0.012
"""Distance that the arm keeps from objects."""
TOUCH_M: Final = -0.003
"""Allowed overlap of hand or load with objects: their balls are a little larger than the truth."""
SAMPLED: Final = np.array([0.06, 0.06, 0.1, 0.06, 0.1, 0.1, 0.12, 0.12, 0.25, 0.25, 0.4])
"""Largest change of each number of a posture between two checks, in metres and radians."""
MOST_SAMPLES: Final = 36
LEVEL: Final = 0.93
"""Cosine of the largest tilt, 21 degrees, at which the contents of a bowl stay inside."""
SCATTER: Final = 0
"""Seed of the scattered postures."""
DRAWS: Final = 24
"""Scattered postures for the search of one path."""


@dataclass(frozen=True, slots=True)
class HeldGeometry:
    """Balls of the held object in the tool's frame: centres (k, 3), radii (k,).

    ``up``, (3,): upward direction in that frame if the object has contents, so that it must stay level.
    """

    centres: FloatArray
    radii: FloatArray
    up: FloatArray | None = None

    def placed(self, postures: FloatArray) -> FloatArray:
        """Centres in the world, (n, k, 3)."""
        rotation, position = body.tools(postures)
        return np.asarray(position[:, None] + self.centres @ rotation.transpose(0, 2, 1))

    def is_level(self, postures: FloatArray) -> BoolArray:
        """Mask, (n,), of postures in which the contents stay inside."""
        if self.up is None:
            return np.ones(len(postures), dtype=np.bool_)
        rotation, _ = body.tools(postures)
        return np.asarray(rotation[:, 2] @ self.up > LEVEL)


def limb_balls(postures: FloatArray, held: HeldGeometry | None) -> tuple[FloatArray, FloatArray]:
    """Return the balls of the arm and of the held object: centres (n, k, 3) and radii (k,)."""
    centres = body.balls(postures)
    if held is None:
        return centres, body.RADII
    return (
        np.concatenate([centres, held.placed(postures)], axis=1),
        np.concatenate([body.RADII, held.radii]),
    )


@dataclass(frozen=True, slots=True)
class ToolPath:
    """Path of the tool in the world: rotations (w, 3, 3) and positions (w, 3).

    ``loaded``, (w,), marks waypoints with the object in the hand. ``key`` is the index of the decisive waypoint.
    """

    rotation: FloatArray
    position: FloatArray
    loaded: BoolArray
    key: int

    @property
    def key_pose(self) -> Pose:
        """Pose of the tool at the key waypoint, in the world."""
        return Pose.from_rotation(tuple(self.position[self.key].tolist()), self.rotation[self.key])


@dataclass(frozen=True, slots=True)
class ArmPath:
    """Postures (w, 11) along a tool path, with the number of the tool path."""

    postures: FloatArray
    number: int
    tool_path: ToolPath


class ArmReach:
    """Search for paths of one hand, empty or loaded, among boxes."""

    def __init__(
        self,
        boxes: Boxes,
        at_work: Boxes,
        held: HeldGeometry | None = None,
        also: Callable[[FloatArray], bool] | None = None,
    ) -> None:
        """``at_work``: boxes without those that the hand may touch at the end of its path.

        ``also``: additional test of paths, (w, 11).
        """
        self._also = also
        self._boxes = boxes
        self._standing = boxes.without((FLOOR,))
        self._at_work = at_work
        self._held = held
        self._collision: BallCollision | None = None

    @property
    def blocker(self) -> str:
        """Owner of the box that blocked the last path; "" for none."""
        return self._collision.owner if self._collision is not None else ""

    def paths(self, tool_paths: Iterable[ToolPath], places: Sequence[FloatArray]) -> Iterator[ArmPath]:
        """Yield free arm paths along the tool paths, preferred ones first, from bases in groups of shape (b, 3).

        A later group is tried where the earlier ones fail. Tool paths are read lazily.
        """
        rest = iter(tool_paths)
        start = 0
        while batch := list(itertools.islice(rest, BATCH)):
            for bases in places:
                yield from self._batch_paths(batch, start, bases)
            start += len(batch)

    def transit(
        self,
        start: FloatArray,
        end: FloatArray,
        *,
        loaded: bool,
        draws: int = DRAWS,
    ) -> FloatArray | None:
        """Return postures, (w, 11), from start to end without contact, None if none are found.

        The arm moves at the base of the start; then the base drives to the base of the end. The arm moves straight, or
        through some of ``draws`` scattered postures.
        """
        held = self._held if loaded else None
        ready = np.concatenate([start[:3], end[3:]])
        if not self._is_free(_between(ready, end), held):
            return None

        def free_up_to(one: FloatArray, other: FloatArray) -> FloatArray:
            between = _between(one, other)[1:]
            free = self._free(between[:-1], self._boxes, held, CLEARANCE_M)
            # Start and end are given, so they are not checked.
            last = bool(np.array_equal(other, ready) or np.array_equal(other, start))
            if free.all() and (last or self._free(other[None], self._boxes, held, CLEARANCE_M)[0]):
                return other
            reached = int(free.argmin()) if not free.all() else len(free)
            return between[reached - 1] if reached else one

        drawn = _scattered(start, draws, level=held is not None and held.up is not None)
        drawn[:1] = (start + ready) / 2
        path = path_between(start, ready, drawn, SAMPLED, free_up_to)
        return None if path is None else np.concatenate([path, end[None]])

    def drives(self, start: FloatArray, end: FloatArray, *, loaded: bool) -> bool:
        """True if the base can drive straight between two postures with the arm unchanged."""
        line = _between(start, end)
        trunk, radii = body.trunk_balls(line)
        hit = collides(self._standing, trunk, radii, 0.0)
        return not hit.any() and self._is_free(line, self._held if loaded else None)

    def _is_free(self, postures: FloatArray, held: HeldGeometry | None) -> bool:
        """True if all postures but the first and the last keep clear."""
        return bool(self._free(postures[1:-1], self._boxes, held, CLEARANCE_M).all())

    def _batch_paths(self, tool_paths: Sequence[ToolPath], first: int, bases: FloatArray) -> list[ArmPath]:
        """Return free paths along a batch of tool paths, best first. ``first`` is the number of its first tool path."""
        tool_path, base, lift, last = _combinations(tool_paths, bases)
        key_rotation = np.stack([one.rotation[one.key] for one in tool_paths])
        key_position = np.stack([one.position[one.key] for one in tool_paths])
        found = body.solve(key_rotation[tool_path], key_position[tool_path], bases[base], lift, last)
        rows, branches = np.nonzero(~np.isnan(found[:, :, -1]))
        if not len(rows):
            return []
        comfort = arm.strain(found[rows, branches][:, body.ARM]) + RANK * tool_path[rows]
        for fore, end in itertools.pairwise(EXAMINED):
            best = _best_of_each(base[rows], comfort, _share(fore, bases), _share(end, bases))
            some = best[self._free(found[rows[best], branches[best]], self._at_work, None, TOUCH_M)]
            row = rows[some]
            paths = self._along(
                [tool_paths[number] for number in tool_path[row].tolist()],
                [first + number for number in tool_path[row].tolist()],
                (bases[base[row]], lift[row], last[row], branches[some]),
            )
            if paths:
                return paths
        return []

    def _along(
        self,
        tool_paths: Sequence[ToolPath],
        numbers: Sequence[int],
        starts: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    ) -> list[ArmPath]:
        """Return the first free, mutually different paths from bases, lifts, last angles and branches."""
        paths: list[ArmPath] = []
        for start in range(0, len(tool_paths), FOLLOWED):
            some = slice(start, start + FOLLOWED)
            followed = _followed(tool_paths[some], *(values[some] for values in starts))
            found = [
                ArmPath(postures, number, tool_path)
                for number, tool_path, postures in zip(numbers[some], tool_paths[some], followed, strict=True)
                if postures is not None
            ]
            for first, last in itertools.pairwise(CHECK_LOTS):
                self._add_free(found[first:last], paths)
                if len(paths) == PATHS_RETURNED:
                    return paths
        return paths

    def _add_free(self, offered: Sequence[ArmPath], paths: list[ArmPath]) -> None:
        """Add free paths that differ from the chosen ones, up to the largest number."""
        unlike = [path for path in offered if not _resembles_any(path, paths)]
        if not unlike:
            return
        for path, (free, hit) in zip(unlike, self._collisions_of(unlike), strict=True):
            if _resembles_any(path, paths):
                continue
            if free and (self._also is None or self._also(path.postures)):
                paths.append(path)
                if len(paths) == PATHS_RETURNED:
                    return
            self._collision = hit or self._collision

    def _collisions_of(self, paths: Sequence[ArmPath]) -> list[tuple[bool, BallCollision | None]]:
        """Return for each path if it is free, and the collision with a box if there is one."""
        postures = np.concatenate([path.postures for path in paths])
        loaded = np.concatenate([path.tool_path.loaded for path in paths])
        number = np.repeat(np.arange(len(paths)), [len(path.postures) for path in paths])
        trunk, trunk_radii = body.trunk_balls(np.stack([path.postures[0] for path in paths]))
        free = ~collides(self._standing, trunk, trunk_radii, TOUCH_M)
        hits: list[BallCollision | None] = [None] * len(paths)
        for mask, held in ((~loaded, None), (loaded, self._held)):
            rows = np.flatnonzero(mask & free[number])
            if not len(rows):
                continue
            clear, seen = self._check(postures[rows], self._at_work, held, TOUCH_M)
            if seen is not None:
                hit = np.flatnonzero(seen.rows)
                for path, row in zip(*np.unique(number[rows[hit]], return_index=True), strict=True):
                    hits[path] = seen.only(hit[row])
            free[number[rows[~clear]]] = False
        return list(zip(free.tolist(), hits, strict=True))

    def _free(
        self, postures: FloatArray, boxes: Boxes, held: HeldGeometry | None, margin_m: float
    ) -> BoolArray:
        """Mask, (n,), of postures in which arm and load keep a margin from the boxes and from the robot's trunk."""
        if not len(postures):
            return np.zeros(0, dtype=np.bool_)
        free, seen = self._check(postures, boxes, held, margin_m)
        if seen is not None:
            self._collision = seen.only(int(seen.rows.argmax()))
        return free

    def _check(
        self, postures: FloatArray, boxes: Boxes, held: HeldGeometry | None, margin_m: float
    ) -> tuple[BoolArray, BallCollision | None]:
        """Return the mask of free postures and the collisions with boxes, for at least one posture."""
        centres, radii = limb_balls(postures, held)
        widest = float(radii.max()) + 0.05
        close = boxes.near(centres.min(axis=(0, 1)) - widest, centres.max(axis=(0, 1)) + widest)
        hit = collides(close, centres, radii, margin_m)
        free = ~hit
        free[free] = ~body.self_collides(postures[free], centres[free], radii)
        if held is not None and held.up is not None:
            free[free] = held.is_level(postures[free])
        return np.asarray(free), BallCollision(close, centres, radii, margin_m, hit) if hit.any() else None


def _share(most: int, bases: FloatArray) -> int:
    """Number of solutions for each base, out of a total."""
    return max(4, most // len(bases)) if most else 0


def _best_of_each(base: FloatArray, cost: FloatArray, first: int, end: int) -> FloatArray:
    """Indices of the cheapest solutions of each base, from ``first`` up to ``end``, the cheapest first."""
    order = np.argsort(cost, kind="stable")
    kept = [order[base[order] == number][first:end] for number in np.unique(base)]
    chosen = np.concatenate(kept)
    return np.asarray(chosen[np.argsort(cost[chosen], kind="stable")])


def _resembles_any(path: ArmPath, paths: Iterable[ArmPath]) -> bool:
    """True if a path begins like one of others."""
    return any(_alike(path.postures[0], other.postures[0]) for other in paths)


def _alike(one: FloatArray, other: FloatArray) -> bool:
    """True if two postures differ so little that the same obstacles block them."""
    return bool(np.abs(one[:2] - other[:2]).max() < 0.1 and np.abs(one[4:] - other[4:]).max() < ALIKE_RAD)


def _combinations(
    tool_paths: Sequence[ToolPath], bases: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Combine tool paths, bases, lifts and last angles: indices in the batch, indices of bases, lifts, angles."""
    heights = np.array(
        [
            tool_path.position[tool_path.key][2]
            - tool_path.rotation[tool_path.key][2, 2] * (arm.FLANGE_M + arm.TOOL_M)
            for tool_path in tool_paths
        ]
    )
    offsets = np.array(OVER_WRIST_M)
    tool_path, base, offset, last = (
        grid.ravel()
        for grid in np.meshgrid(
            np.arange(len(tool_paths)), np.arange(len(bases)), offsets, LAST_RAD, indexing="ij"
        )
    )
    lift = heights[tool_path] + offset - SHOULDER_LOW_M
    return tool_path, base, np.clip(lift, 0.0, LIFT_M - LIFT_SPARE_M), last


def _followed(
    tool_paths: Sequence[ToolPath],
    bases: FloatArray,
    lifts: FloatArray,
    last: FloatArray,
    branches: FloatArray,
) -> list[FloatArray | None]:
    """Return postures along each of n tool paths with fixed base, lift and last joint; None out of reach or at a jump.

    bases: (n, 3), lifts: (n,), last: (n,), branches: (n,).
    """
    counts = np.array([len(tool_path.position) for tool_path in tool_paths])
    row = np.repeat(np.arange(len(tool_paths)), counts)
    rotation = np.concatenate([tool_path.rotation for tool_path in tool_paths])
    position = np.concatenate([tool_path.position for tool_path in tool_paths])
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


def _scattered(start: FloatArray, count: int, *, level: bool) -> FloatArray:
    """Return scattered postures, (n, 11), at the base of the start; ``level``: the load only turns about z.

    They are always the same, so that a path found once in a scene is found again.
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
    """Return postures from start to end, (n, 11), close enough to detect thin obstacles."""
    count = int(np.ceil((np.abs(end - start) / SAMPLED).max())) + 2
    shares = np.linspace(0.0, 1.0, min(count, MOST_SAMPLES))[:, None]
    return np.asarray(start + shares * (end - start))
