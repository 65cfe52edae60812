"""Folding and unfolding of the arm: paths between the carrying posture over the base and the start of the work."""

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from embomatrix.sim.bullet.robot import TUCKED_ARM, TUCKED_LIFT_M
from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.motion import standing, with_arm
from embomatrix.sim.physical.reach import CLEARANCE_M, ArmPath, ArmReach, HeldGeometry
from embomatrix.sim.physical.space import Boxes, collides
from embomatrix.sim.physical.stage import PhysicalStage, compact
from embomatrix.sim.physical.travel import SOMETHING, travel
from embomatrix.sim.robot_dimensions import SHOULDER_LOW_M
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.geometry import FloatArray
from embomatrix.world.poses import StandPose

PATHS_TRIED: Final = 16
ATTEMPTS: Final = 3
"""Paths to examine, and how many of them the arm attempts."""
BACK_OFF_M: Final = (0.0, 0.3, 0.55)
"""Distances before the place of work at which the arm unfolds."""
RETREATS_M: Final = (0.2, 0.4, 0.6)
ASIDES: Final = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0)
"""Distances, and directions in degrees from straight back, in which the base retreats to get room to fold."""
DRAWS: Final = 100
"""Random postures for folding. A high number pays off: an arm that stays out blocks all later paths."""
TURN_RAD: Final = 0.01
FOLDS: Final = 3
"""Attempts to fold. An obstacle on one path determines the start of the next."""
CARRY_LIFT_M: Final = 0.6
"""Height of the lift while the robot drives with a load."""
SURROUNDINGS_M: Final = np.array([0.8, 0.8, 9.0])
OVER_M: Final = 1.0
"""Preferred minimum height of loads while driving, above counters."""


def approach(stage: PhysicalStage, path: ArmPath, reach: ArmReach, *, loaded: bool) -> FloatArray | None:
    """Return postures, (w, 11), that lead to the start of a path, None if none are found.

    The arm unfolds at the place of work, or some distance before it, from where the base drives on with the arm ready.
    """
    start = path.postures[0]
    now = stage.mover.posture
    back = -np.array([math.cos(start[body.YAW]), math.sin(start[body.YAW]), 0.0])
    for away in BACK_OFF_M:
        spot = start[:3] + away * back
        if away and not stage.floor.grid.drives_straight(_pair(spot), _pair(start)):
            continue
        swing = reach.transit(standing(now, spot), start, loaded=loaded)
        if swing is not None:
            return swing
    return None


def arrivals(
    stage: PhysicalStage, paths: Iterable[ArmPath], reach: ArmReach, *, loaded: bool
) -> Iterator[tuple[ArmPath, SkillRefusal | None]]:
    """Bring the arm to the start of one path after another. Yield each path with the refusal that stopped the arm, if any."""
    attempts = 0
    for path in itertools.islice(paths, PATHS_TRIED):
        swing = approach(stage, path, reach, loaded=loaded)
        if swing is None:
            continue
        attempts += 1
        yield path, unfold(stage, swing)
        if attempts == ATTEMPTS:
            return


def unfold(stage: PhysicalStage, swing: FloatArray) -> SkillRefusal | None:
    """Drive to the start of a swing, and make it."""
    now = stage.mover.posture
    turns = abs(math.remainder(now[body.YAW] - swing[0, body.YAW], math.tau)) > TURN_RAD
    # An arm left out sweeps over its surroundings while the base turns.
    if math.dist(now[:2], swing[0, :2]) > 0.01 or (turns and not compact(stage, now)):
        refusal = travel(stage, StandPose(*swing[0, :3].tolist()))
        if refusal is not None:
            return refusal
    hit = stage.mover.sweep(swing)
    if hit is not None:
        return refuse(FailureReason.ARM_BLOCKED, target=SOMETHING, other=hit or SOMETHING)
    return None


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def fold(stage: PhysicalStage, home: StandPose, target: str = "") -> SkillRefusal | None:
    """Bring the arm with its load over the base, and the base back to ``home``.

    If there is no room to fold, the base first retreats. Contact of the hand at the start is allowed.
    """
    for _ in range(FOLDS):
        if _folded_over_base(stage):
            break
    now = stage.mover.posture
    if (
        math.dist(now[:2], (home.x_m, home.y_m)) > 0.01
        or abs(math.remainder(now[2] - home.yaw, math.tau)) > 0.01
    ):
        return travel(stage, home, target)
    stage.commanded = home
    return None


def _folded_over_base(stage: PhysicalStage) -> bool:
    """True if the arm is over the base, or finds no path there; False if an obstacle stopped it."""
    now = stage.mover.posture
    balls, radii = stage.limbs(now[None])
    reach = stage.reach(stage.boxes().shrunk_clear_of(balls[0], radii, CLEARANCE_M))
    loaded = stage.grip is not None
    folded = carrying(stage, now)
    for spot in _retreats(reach, now, loaded):
        there = standing(now, spot)
        swing = reach.transit(there, standing(folded, spot), loaded=loaded, draws=DRAWS)
        if swing is not None:
            return stage.mover.sweep(swing) is None
    return True


def _retreats(reach: ArmReach, now: FloatArray, loaded: bool) -> Iterator[FloatArray]:
    """Yield bases, (3,), at which the arm may fold: here, then places that the base reaches in a straight line."""
    yield now[:3]
    for away, aside in itertools.product(RETREATS_M, ASIDES):
        course = now[body.YAW] + math.pi + math.radians(aside)
        spot = now[:3] + away * np.array([math.cos(course), math.sin(course), 0.0])
        if reach.drives(now, standing(now, spot), loaded=loaded):
            yield spot


def carrying(stage: PhysicalStage, now: FloatArray) -> FloatArray:
    """Return the driving posture: folded with an empty hand, else with the load upright and near."""
    if stage.grip is None:
        folded = with_arm(now, np.array(TUCKED_ARM))
        folded[body.LIFT] = TUCKED_LIFT_M
        return folded
    rotation, where = _carried_to(now)
    count = len(where)
    boxes = stage.boxes_within(now[:3] - SURROUNDINGS_M, now[:3] + SURROUNDINGS_M)
    bases, lift = np.tile(now[:3], (count, 1)), np.full(count, CARRY_LIFT_M)
    best, found = math.inf, now
    for last in (0.785, -0.785, 2.3, -2.3, 1.57):
        rows = body.solve(rotation, where, bases, lift, np.full(count, last)).reshape(-1, body.NUMBERS)
        rows = rows[~np.isnan(rows[:, -1])]
        if not len(rows):
            continue
        cost = _carrying_cost(rows, now, stage.grip.held, boxes)
        if cost.min() < best:
            best, found = float(cost.min()), rows[int(cost.argmin())]
    return found


def _carried_to(now: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return tool poses over the base that keep the load upright: rotations (n, 3, 3) and positions (n, 3)."""
    rotation, _ = body.tools(now[None])
    turns, xs, ys, heights = (
        grid.ravel()
        for grid in np.meshgrid(
            np.arange(8) * math.pi / 4,
            (0.1, 0.2, 0.3, 0.4, 0.5),
            (-0.25, 0.0, 0.25),
            (0.1, 0.3, 0.5),
            indexing="ij",
        )
    )
    yaw = arm.about_z(now[None, body.YAW])[0]
    local = np.stack([xs, ys, np.zeros(len(turns))], axis=1)
    where = local @ yaw.T + np.array([now[0], now[1], 0.0])
    where[:, 2] = SHOULDER_LOW_M + CARRY_LIFT_M + heights
    return arm.about_z(turns) @ rotation[0], where


def _carrying_cost(rows: FloatArray, now: FloatArray, held: HeldGeometry, boxes: Boxes) -> FloatArray:
    """Cost, (n,), of driving with postures, (n, 11): wide, high, low over counters, far from now, or in collision."""
    load, arms = held.placed(rows), body.balls(rows)
    wide = np.linalg.norm(load[:, :, :2] - now[:2], axis=2) + held.radii
    limbs = np.linalg.norm(arms[:, :, :2] - now[:2], axis=2) + body.RADII
    top = np.maximum((load[:, :, 2] + held.radii).max(axis=1), (arms[:, :, 2] + body.RADII).max(axis=1))
    bottom = (load[:, :, 2] - held.radii).min(axis=1)
    cost = np.maximum(top - ROBOT.height_m, 0.0) + 0.3 * np.maximum(OVER_M - bottom, 0.0)
    cost += 0.04 * np.abs(rows[:, 4:] - now[4:]).max(axis=1)
    cost += np.maximum(wide.max(axis=1), limbs.max(axis=1))
    radii = np.concatenate([body.RADII, held.radii])
    points = np.concatenate([arms, load], axis=1)
    cost += np.where(collides(boxes, points, radii, CLEARANCE_M), 2.0, 0.0)
    return np.where(body.self_collides(rows, points, radii), math.inf, cost)
