"""Driving: along the navigation grid's corners, turned so that arm and load pass, and stopped by what is hit."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical import body
from embomatrix.sim.physical.space import struck
from embomatrix.sim.physical.stage import compact
from embomatrix.sim.placing.trial import in_reach
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from embomatrix.sim.physical.stage import PhysicalStage
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.geometry import FloatArray

    BoolArray = NDArray[np.bool_]

HEADINGS: Final = 24
SPACING_M: Final = 0.12
"""Along the way the load's room is looked at this often."""
TURNS: Final = 12
"""Marks at either end at which the robot may turn on the spot."""
MOST_STEPS: Final = 1
"""Headings that it may turn by from one mark to the next."""
CHAINS: Final = 4
"""Ways to turn on the way that are looked at: what one strikes between two headings, the next avoids."""
BETWEEN: Final = 3
"""Headings between two that are looked at where the robot turns."""
BACK_OUT_M: Final = (0.2, 0.4, 0.6)
"""So far the robot draws a load straight back where it can't turn with it."""
BLOCKED_COST: Final = 100.0
BESIDE_COST: Final = 1.0
STRUCK_M: Final = 0.005
BESIDE_M: Final = 0.05
SOMETHING: Final = "something"


def travel(stage: PhysicalStage, goal: StandPose, target: str = "") -> SkillRefusal | None:
    """Drive to a pose on the floor, or where an open door takes that place beside it, where the target is in reach too."""
    here = stage.mover.posture[:3]
    way = stage.floor.way((float(here[0]), float(here[1])), goal, lambda spot: _serves(stage, spot, target))
    if way is not None:
        return drive(stage, way[0], way[1].yaw)
    # Only a door stands in the way, as the planner knows of a path: drive against it, and physics says what gives.
    corners = stage.world.navigator.path(StandPose(*here.tolist()), goal)
    return drive(stage, np.array([here[:2], *corners, (goal.x_m, goal.y_m)]), goal.yaw)


def _serves(stage: PhysicalStage, spot: StandPose, target: str) -> bool:
    """Whether a target is in reach from a spot, with nothing between; without a target any spot will do."""
    if not target or target in stage.world.carried:
        return True
    box = stage.world.relations.body(target)
    return in_reach(box, spot) and stage.world.navigator.line_is_clear(spot, target)


def drive(stage: PhysicalStage, points: FloatArray, yaw: float) -> SkillRefusal | None:
    """Drive along straight lines between points, (n, 2), the first of which is here, and end with a heading.

    What the robot was told is the end, and the heading even where its load keeps it from facing there.
    """
    stage.told = StandPose(float(points[-1, 0]), float(points[-1, 1]), yaw)
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
    """Marks, (n, 2), and headings, (n,), along lines between points: where a load finds no room to turn, back out first."""
    marks, headings, struck = _headings(stage, start, _resampled(points), yaw)
    grid, here = stage.floor.grid, (float(points[0, 0]), float(points[0, 1]))
    for away in BACK_OUT_M if struck and len(points) > 1 else ():
        spot = (here[0] - away * math.cos(start[body.YAW]), here[1] - away * math.sin(start[body.YAW]))
        onward = (float(points[1, 0]), float(points[1, 1]))
        if grid.drives_straight(here, spot) and grid.drives_straight(spot, onward):
            longer = _resampled(np.array([here, spot, *points[1:]]))
            other, turned, less = _headings(stage, start, longer, yaw)
            if less < struck:
                marks, headings, struck = other, turned, less
    return marks, headings


def _resampled(points: FloatArray) -> FloatArray:
    """Points along the lines, none farther than the spacing from the next, corners kept."""
    rows = [points[:1]]
    for first, second in itertools.pairwise(points):
        count = max(1, math.ceil(float(np.linalg.norm(second - first)) / SPACING_M))
        rows.append(first + np.linspace(0.0, 1.0, count + 1)[1:, None] * (second - first))
    return np.concatenate(rows)


def _headings(
    stage: PhysicalStage, start: FloatArray, marks: FloatArray, yaw: float
) -> tuple[FloatArray, FloatArray, int]:
    """Marks, (n, 2), a heading at each, (n,), and at how many something is struck all the same.

    Any heading will do where the arm is folded, else one that lets arm and load pass. With a load there is time to turn at both
    ends.
    """
    begin = start[body.YAW]
    end = begin + math.remainder(yaw - begin, math.tau)
    if compact(stage, start):
        # Who turns on the spot has one mark: it is the end.
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
        strikes = _turns_striking(stage, start, marks, found)
        if not (strikes & (swept[number, chosen[:-1], chosen[1:]] == 0.0)).any():
            break
        swept[number[strikes], chosen[:-1][strikes], chosen[1:][strikes]] = BLOCKED_COST
    # The first mark is where the robot is: what it touches there it touches already.
    struck = int((strikes | (danger[number, chosen[1:]] >= BLOCKED_COST)).sum())
    nearest = found[-1] + math.remainder(end - found[-1], math.tau)
    last, turned = np.tile(marks[-1], (2, 1)), np.array([found[-1], nearest])
    if abs(nearest - found[-1]) <= math.tau / HEADINGS and not _turns_striking(stage, start, last, turned)[0]:
        found[-1] = nearest
    return marks, found, struck


def _turns_striking(
    stage: PhysicalStage, start: FloatArray, marks: FloatArray, headings: FloatArray
) -> BoolArray:
    """Where arm or load strike something on the turn from one mark to the next, (marks - 1,).

    An outstretched arm goes far between two headings, past what is at neither.
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
    """Numbers of headings, one a mark, the first of them 0: little turning, nothing struck, and the wanted heading in the end.

    danger: (marks, headings); swept: (marks, headings, headings) what it costs to turn so before a mark; off: (headings,) how
    far each is from the one that is wanted.
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
    """What it costs to have arm and load at marks with headings, (marks, headings): much in things, little beside them."""
    bases = np.column_stack([np.repeat(marks, len(options), axis=0), np.tile(options, len(marks))])
    return _cost_at(stage, start, bases).reshape(len(marks), len(options))


def _cost_at(stage: PhysicalStage, start: FloatArray, bases: FloatArray) -> FloatArray:
    """The same for bases, (n, 3): shape (n,)."""
    rows = np.tile(start, (len(bases), 1))
    rows[:, : body.LIFT] = bases
    centres, radii = body.balls(rows), body.RADII
    if stage.grip is not None:
        centres = np.concatenate([centres, stage.grip.held.placed(rows)], axis=1)
        radii = np.concatenate([radii, stage.grip.held.radii])
    far = np.linalg.norm(centres[0, :, :2] - rows[0, :2], axis=1) + radii > 0.2
    centres, radii = centres[:, far], radii[far]
    wide = float(radii.max()) + BESIDE_M
    boxes = stage.boxes_within(centres.min(axis=(0, 1)) - wide, centres.max(axis=(0, 1)) + wide)
    cost = np.zeros(len(bases))
    # A few at a time: of what is along the whole way, little is near any place of it.
    for first in range(0, len(bases), HEADINGS):
        some = centres[first : first + HEADINGS]
        close = boxes.near(some.min(axis=(0, 1)) - wide, some.max(axis=(0, 1)) + wide)
        beside = first + np.flatnonzero(struck(close, some, radii, BESIDE_M))
        cost[beside] = BESIDE_COST
        cost[beside[struck(close, centres[beside], radii, STRUCK_M)]] = BLOCKED_COST
    return cost
