"""Driving: along the navigation grid's corners, turned so that arm and load pass, and stopped by what is hit."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim import physical_body as body
from embomatrix.sim.physical_space import strikes
from embomatrix.sim.physical_stage import compact
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from embomatrix.sim.physical_stage import Stage
    from embomatrix.skills.view import Refusal
    from embomatrix.world.geometry import FloatArray

HEADINGS: Final = 16
SPACING_M: Final = 0.12
"""Along the way the load's room is looked at this often."""
BLOCKED_COST: Final = 20.0
SOMETHING: Final = "something"


def travel(stage: Stage, goal: StandPose) -> Refusal | None:
    """Drive to a pose on the floor, or where an open door takes that place beside it."""
    here = stage.mover.posture[:3]
    way = stage.floor.way((float(here[0]), float(here[1])), goal)
    if way is not None:
        return drive(stage, way[0], way[1].yaw)
    # Only a door stands in the way, as the planner knows of a path: drive against it, and physics says what gives.
    corners = stage.world.navigator.path(StandPose(*here.tolist()), goal)
    return drive(stage, np.array([here[:2], *corners, (goal.x_m, goal.y_m)]), goal.yaw)


def drive(stage: Stage, points: FloatArray, yaw: float) -> Refusal | None:
    """Drive along straight lines between points, (n, 2), the first of which is here, and end with a heading."""
    start = stage.mover.posture
    marks = _resampled(points)
    headings = _headings(stage, start, marks, yaw)
    postures = np.tile(start, (len(marks), 1))
    postures[:, : body.LIFT] = np.column_stack([marks, headings])
    hit = stage.mover.follow(postures[1:] if len(postures) > 1 else postures)
    if hit is not None:
        return refuse(FailureReason.COLLIDED, other=hit or SOMETHING)
    if stage.has_slipped():
        return refuse(FailureReason.SLIPPED, target=stage.grip.name if stage.grip else "")
    return None


def _resampled(points: FloatArray) -> FloatArray:
    """Points along the lines, none farther than the spacing from the next, corners kept."""
    rows = [points[:1]]
    for first, second in itertools.pairwise(points):
        count = max(1, math.ceil(float(np.linalg.norm(second - first)) / SPACING_M))
        rows.append(first + np.linspace(0.0, 1.0, count + 1)[1:, None] * (second - first))
    return np.concatenate(rows)


def _headings(stage: Stage, start: FloatArray, marks: FloatArray, yaw: float) -> FloatArray:
    """A heading at each mark, (n,): any where the arm is folded, else one that lets arm and load pass."""
    count = len(marks)
    begin = start[body.YAW]
    end = begin + math.remainder(yaw - begin, math.tau)
    even = begin + (end - begin) * np.linspace(0.0, 1.0, count)
    if compact(stage, start):
        return even
    options = begin + np.arange(HEADINGS) * math.tau / HEADINGS
    blocked = _blocked(stage, start, marks, options)
    step = np.abs(np.arange(HEADINGS)[:, None] - np.arange(HEADINGS)[None])
    turn = np.minimum(step, HEADINGS - step) * (math.tau / HEADINGS)
    # Cheapest chain of headings: little turning, nothing struck, and the wanted heading in the end.
    wanted = np.abs([math.remainder(option - end, math.tau) for option in options])
    cost = np.where(np.arange(HEADINGS) == 0, 0.0, 1e6)
    back = np.zeros((count, HEADINGS), dtype=int)
    for number in range(1, count):
        total = cost[:, None] + turn
        back[number] = total.argmin(axis=0)
        cost = total.min(axis=0) + BLOCKED_COST * blocked[number]
    chosen = [int((cost + 2.0 * wanted).argmin())]
    for number in range(count - 1, 0, -1):
        chosen.append(int(back[number][chosen[-1]]))
    found = np.unwrap(options[chosen[::-1]])
    nearest = found[-1] + math.remainder(end - found[-1], math.tau)
    last = np.append(found[:-1], nearest)
    return last if not _blocked(stage, start, marks[-1:], np.array([nearest]))[0, 0] else found


def _blocked(stage: Stage, start: FloatArray, marks: FloatArray, options: FloatArray) -> FloatArray:
    """Whether arm or load would strike something at marks with headings, shape (marks, headings)."""
    rows = np.tile(start, (len(marks) * len(options), 1))
    rows[:, :2] = np.repeat(marks, len(options), axis=0)
    rows[:, body.YAW] = np.tile(options, len(marks))
    centres, radii = body.balls(rows), body.RADII
    if stage.grip is not None:
        centres = np.concatenate([centres, stage.grip.held.placed(rows)], axis=1)
        radii = np.concatenate([radii, stage.grip.held.radii])
    far = np.linalg.norm(centres[0, :, :2] - rows[0, :2], axis=1) + radii > 0.2
    centres, radii = centres[:, far], radii[far]
    low, high = centres.min(axis=(0, 1)) - 0.1, centres.max(axis=(0, 1)) + 0.1
    boxes = stage.boxes_within(low, high)
    return (strikes(boxes, centres, radii, 0.01) >= 0).reshape(len(marks), len(options))
