"""Standing poses from which the robot works on an object: near, in front of it, with a free line for the arm."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.floor.obstacles import FLAT_M, crosses
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, FloatArray, Vec2
from embomatrix.world.poses import StandPose

REACH_SLACK_M: Final = 0.05
"""Standing poses are this much nearer than the arm reaches, as slack for objects off their box's edge."""
FRONT_COSINE: Final = math.cos(math.radians(65.0))
"""Objects with a front are served from within 65 degrees of it."""
STANDS: Final = 8
APART_M: Final = 0.25
"""Smallest distance between standing poses of one object."""
TRIED: Final = 96
SIDE_WEIGHT_M: Final = 0.4
"""Cost of standing at the side, as a distance from the front."""


@dataclass(frozen=True, slots=True)
class StandingArea:
    """Conditions on a place that serves an object: ``blockers``, shape (4, n), are rectangles that the arm can't pass.

    ``front_yaw`` is the front of the object, or of the furniture that holds it; ``from_front`` restricts the robot to it.
    """

    box: Aabb
    front_yaw: float
    from_front: bool
    blockers: FloatArray

    @property
    def window(self) -> tuple[Vec2, Vec2]:
        """Corners of the rectangle that contains all such places."""
        reach = ROBOT.reach_m - REACH_SLACK_M
        (low_x, low_y, _), (high_x, high_y, _) = self.box.low_m, self.box.high_m
        return (low_x - reach, low_y - reach), (high_x + reach, high_y + reach)

    def stands(self, centers: FloatArray) -> tuple[StandPose, ...]:
        """Up to eight poses at these points, shape (n, 2): the cheapest with a clear line, spaced apart."""
        nearest, cost = self._weigh(centers)
        chosen: list[StandPose] = []
        tried = 0
        for index in np.argsort(cost, kind="stable").tolist():
            if not math.isfinite(cost[index]) or len(chosen) == STANDS or tried == TRIED:
                break
            x, y = centers[index].tolist()
            if any(math.hypot(x - other.x_m, y - other.y_m) < APART_M for other in chosen):
                continue
            tried += 1
            tx, ty = nearest[index].tolist()
            if not crosses((x, y), (tx, ty), self.blockers):
                chosen.append(StandPose(x, y, math.atan2(ty - y, tx - x)))
        return tuple(chosen)

    def nearest(self, centers: FloatArray, place: StandPose) -> StandPose | None:
        """Serving pose among these points, shape (n, 2), nearest to a place; None for none."""
        nearest, cost = self._weigh(centers)
        away = np.hypot(centers[:, 0] - place.x_m, centers[:, 1] - place.y_m)
        for index in np.argsort(away, kind="stable").tolist():
            x, y = centers[index].tolist()
            tx, ty = nearest[index].tolist()
            if math.isfinite(cost[index]) and not crosses((x, y), (tx, ty), self.blockers):
                return StandPose(x, y, math.atan2(ty - y, tx - x))
        return None

    def serving(self, centers: FloatArray) -> FloatArray:
        """Points, shape (n, 2), that would serve the object if they were free."""
        nearest, cost = self._weigh(centers)
        good = [
            index
            for index in np.flatnonzero(np.isfinite(cost)).tolist()
            if not crosses(tuple(centers[index].tolist()), tuple(nearest[index].tolist()), self.blockers)
        ]
        return np.asarray(centers[good], dtype=np.float64)

    def _weigh(self, centers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nearest point of the box to each centre, shape (n, 2), and its cost, shape (n,); infinite for unsuitable centres."""
        middle = np.array(self.box.center_m[:2])
        nearest = np.clip(centers, np.array(self.box.low_m[:2]), np.array(self.box.high_m[:2]))
        away = np.linalg.norm(centers - nearest, axis=1)
        to_robot = centers - middle
        far = np.linalg.norm(to_robot, axis=1)
        front = np.array((math.cos(self.front_yaw), math.sin(self.front_yaw)))
        cosines = (to_robot / np.maximum(far, 1e-9)[:, None]) @ front
        fits = away <= ROBOT.reach_m - REACH_SLACK_M
        if self.box.high_m[2] <= FLAT_M:
            away = away + far  # the robot stands on rugs and floors, near their middle
        else:
            fits &= away >= ROBOT.shoulder_m
        if self.from_front:
            fits &= cosines >= FRONT_COSINE
        return nearest, np.where(fits, away + SIDE_WEIGHT_M * (1 - cosines) / 2, np.inf)
