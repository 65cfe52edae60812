"""Driving: along the corners of a route, with headings at which arm and load pass, stopped by collisions."""

import itertools
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.physical import body
from embomatrix.sim.physical.space import collides
from embomatrix.sim.physical.stage import PhysicalStage, compact
from embomatrix.sim.placing.search import in_reach
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.geometry import FloatArray
from embomatrix.world.poses import StandPose

BoolArray = NDArray[np.bool_]

HEADINGS: Final = 24
SPACING_M: Final = 0.12
"""Spacing of the collision checks of arm and load along the route."""
TURNS: Final = 12
"""Marks at either end at which the robot may turn on the spot."""
MOST_STEPS: Final = 1
"""Headings by which the robot may turn between two marks."""
CHAINS: Final = 4
"""Attempts to find headings. Turns that collide in one attempt are avoided in the next."""
BETWEEN: Final = 3
"""Intermediate headings to check during a turn."""
BACK_OUT_M: Final = (0.2, 0.4, 0.6)
"""Distances by which the robot draws a load straight back if it can't turn with it."""
BLOCKED_COST: Final = 100.0
BESIDE_COST: Final = 1.0
STRUCK_M: Final = 0.005
BESIDE_M: Final = 0.05
SOMETHING: Final = "something"


def travel(stage: PhysicalStage, goal: StandPose, target: str = "") -> SkillRefusal | None:
    """Drive to a pose on the floor. If it is occupied, drive to a pose beside it from which the target is in reach."""
    here = stage.mover.posture[:3]
    path = stage.floor.route(
        (float(here[0]), float(here[1])), goal, lambda spot: _serves(stage, spot, target)
    )
    if path is not None:
        return drive(stage, path[0], path[1].yaw)
    # Only a door is in the way, because the planner knows a path: drive against it and let physics decide.
    corners = stage.world.navigator.path(StandPose(*here.tolist()), goal)
    return drive(stage, np.array([here[:2], *corners, (goal.x_m, goal.y_m)]), goal.yaw)


def _serves(stage: PhysicalStage, spot: StandPose, target: str) -> bool:
    """True if the target is in reach from a pose with nothing between. Any pose serves without a target."""
    if not target or target in stage.world.carried:
        return True
    box = stage.world.relations.body(target)
    return in_reach(box, spot) and stage.world.navigator.line_is_clear(spot, target)


def drive(stage: PhysicalStage, points: FloatArray, yaw: float) -> SkillRefusal | None:
    """Drive along straight lines between points, (n, 2), starting here, and end with a heading.

    The commanded pose is the end with that heading, even if the load keeps the robot from facing there.
    """
    stage.commanded = StandPose(float(points[-1, 0]), float(points[-1, 1]), yaw)
    start = stage.mover.posture
    marks, headings = _course(stage, start, points, yaw)
    postures = np.tile(start, (len(marks), 1))
    postures[:, : body.LIFT] = np.column_stack([marks, headings])
    hit = stage.mover.sweep(postures[1:] if len(postures) > 1 else postures)
    if hit is not None:
        return refuse(FailureReason.COLLIDED, other=hit or SOMETHING)
    if stage.has_slipped():
        return refuse(FailureReason.SLIPPED, target=stage.grip.name if stage.grip else "")
    return None


def _course(
    stage: PhysicalStage, start: FloatArray, points: FloatArray, yaw: float
) -> tuple[FloatArray, FloatArray]:
    """Return marks, (n, 2), and headings, (n,), along lines between points. Back out first if a load has no room to turn."""
    marks, headings, collisions = _headings(stage, start, _resampled(points), yaw)
    grid, here = stage.floor.grid, (float(points[0, 0]), float(points[0, 1]))
    for away in BACK_OUT_M if collisions and len(points) > 1 else ():
        spot = (here[0] - away * math.cos(start[body.YAW]), here[1] - away * math.sin(start[body.YAW]))
        onward = (float(points[1, 0]), float(points[1, 1]))
        if grid.drives_straight(here, spot) and grid.drives_straight(spot, onward):
            longer = _resampled(np.array([here, spot, *points[1:]]))
            other, turned, fewer = _headings(stage, start, longer, yaw)
            if fewer < collisions:
                marks, headings, collisions = other, turned, fewer
    return marks, headings


def _resampled(points: FloatArray) -> FloatArray:
    """Return points along the lines, spaced at most ``SPACING_M`` apart, with the corners."""
    rows = [points[:1]]
    for first, second in itertools.pairwise(points):
        count = max(1, math.ceil(float(np.linalg.norm(second - first)) / SPACING_M))
        rows.append(first + np.linspace(0.0, 1.0, count + 1)[1:, None] * (second - first))
    return np.concatenate(rows)


def _headings(
    stage: PhysicalStage, start: FloatArray, marks: FloatArray, yaw: float
) -> tuple[FloatArray, FloatArray, int]:
    """Return marks, (n, 2), a heading at each, (n,), and the number of marks with a collision.

    Any heading is good with a folded arm. With a load the robot may turn on the spot at both ends.
    """
    begin = start[body.YAW]
    end = begin + math.remainder(yaw - begin, math.tau)
    if compact(stage, start):
        # A turn on the spot has one mark, the end.
        shares = np.linspace(0.0, 1.0, len(marks)) if len(marks) > 1 else np.ones(1)
        return marks, begin + (end - begin) * shares, 0
    marks = np.concatenate([np.tile(marks[0], (TURNS, 1)), marks, np.tile(marks[-1], (TURNS, 1))])
    options = begin + np.arange(HEADINGS) * math.tau / HEADINGS
    danger = _danger(stage, start, marks[TURNS - 1 : 1 - TURNS], options)
    danger = np.concatenate([np.tile(danger[0], (TURNS - 1, 1)), danger, np.tile(danger[-1], (TURNS - 1, 1))])
    off = np.abs([math.remainder(option - end, math.tau) for option in options])
    swept = np.zeros((len(marks), HEADINGS, HEADINGS))
    number = np.arange(1, len(marks))
    for _ in range(CHAINS):
        chosen = np.array(_cheapest_chain(danger, swept, off))
        found = np.unwrap(options[chosen])
        strikes = _colliding_turns(stage, start, marks, found)
        if not (strikes & (swept[number, chosen[:-1], chosen[1:]] == 0.0)).any():
            break
        swept[number[strikes], chosen[:-1][strikes], chosen[1:][strikes]] = BLOCKED_COST
    # Contacts at the first mark exist already and don't count.
    collisions = int((strikes | (danger[number, chosen[1:]] >= BLOCKED_COST)).sum())
    nearest = found[-1] + math.remainder(end - found[-1], math.tau)
    last, turned = np.tile(marks[-1], (2, 1)), np.array([found[-1], nearest])
    if (
        abs(nearest - found[-1]) <= math.tau / HEADINGS
        and not _colliding_turns(stage, start, last, turned)[0]
    ):
        found[-1] = nearest
    return marks, found, collisions


def _colliding_turns(
    stage: PhysicalStage, start: FloatArray, marks: FloatArray, headings: FloatArray
) -> BoolArray:
    """Mask, (marks - 1,), of turns between marks in which arm or load collide.

    An outstretched arm sweeps far between two headings.
    """
    turning = np.flatnonzero(np.abs(np.diff(headings)) > 0.0)
    found = np.zeros(len(marks) - 1, dtype=np.bool_)
    if len(turning):
        shares = np.linspace(0.0, 1.0, BETWEEN + 2)[1:, None]
        bases = np.column_stack([marks, headings])
        on_way = bases[turning, None] + shares * (bases[turning + 1] - bases[turning])[:, None]
        cost = _cost_at(stage, start, on_way.reshape(-1, body.LIFT)).reshape(len(turning), -1)
        found[turning] = (cost >= BLOCKED_COST).any(axis=1)
    return found


def _cheapest_chain(danger: FloatArray, swept: FloatArray, off: FloatArray) -> list[int]:
    """Return indices of headings, one for each mark and 0 first: little turning, no collision, the wanted heading last.

    danger: (marks, headings); swept: (marks, headings, headings) cost of a turn before a mark; off: (headings,) distance to the
    wanted heading.
    """
    step = np.abs(np.arange(HEADINGS)[:, None] - np.arange(HEADINGS)[None])
    step = np.minimum(step, HEADINGS - step)
    turn = np.where(step <= MOST_STEPS, step * math.tau / HEADINGS, np.inf)
    cost = np.where(np.arange(HEADINGS) == 0, 0.0, np.inf)
    back = np.zeros((len(danger), HEADINGS), dtype=int)
    for number in range(1, len(danger)):
        total = cost[:, None] + turn + swept[number]
        back[number] = total.argmin(axis=0)
        cost = total.min(axis=0) + danger[number]
    chosen = [int((cost + 2.0 * off).argmin())]
    for number in range(len(danger) - 1, 0, -1):
        chosen.append(int(back[number][chosen[-1]]))
    return chosen[::-1]


def _danger(stage: PhysicalStage, start: FloatArray, marks: FloatArray, options: FloatArray) -> FloatArray:
    """Cost, (marks, headings), of arm and load at marks with headings: high in collision, low beside objects."""
    bases = np.column_stack([np.repeat(marks, len(options), axis=0), np.tile(options, len(marks))])
    return _cost_at(stage, start, bases).reshape(len(marks), len(options))


def _cost_at(stage: PhysicalStage, start: FloatArray, bases: FloatArray) -> FloatArray:
    """Cost, (n,), of arm and load at bases, (n, 3)."""
    rows = np.tile(start, (len(bases), 1))
    rows[:, : body.LIFT] = bases
    centres, radii = stage.limbs(rows)
    far = np.linalg.norm(centres[0, :, :2] - rows[0, :2], axis=1) + radii > 0.2
    centres, radii = centres[:, far], radii[far]
    wide = float(radii.max()) + BESIDE_M
    boxes = stage.boxes_within(centres.min(axis=(0, 1)) - wide, centres.max(axis=(0, 1)) + wide)
    cost = np.zeros(len(bases))
    # Check a few marks at a time: few boxes are near any one of them.
    for first in range(0, len(bases), HEADINGS):
        some = centres[first : first + HEADINGS]
        close = boxes.near(some.min(axis=(0, 1)) - wide, some.max(axis=(0, 1)) + wide)
        beside = first + np.flatnonzero(collides(close, some, radii, BESIDE_M))
        cost[beside] = BESIDE_COST
        cost[beside[collides(close, centres[beside], radii, STRUCK_M)]] = BLOCKED_COST
    return cost
