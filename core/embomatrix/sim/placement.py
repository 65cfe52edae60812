"""Where a held object goes when it is placed: the first verified pose that is still free and in reach."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.sim.candidates import candidates
from embomatrix.sim.engine import FLOOR, TOLERANCE_M
from embomatrix.sim.spots import is_upright
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.poses import PlacementKey
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.relations import Relations
    from embomatrix.world.geometry import Aabb, Pose
    from embomatrix.world.poses import PoseCache, StandPose

UNDISTURBED_M: Final = 0.005
"""A pose that was verified offline is settled again when anything but its support is this near."""
LIVE_TRIES: Final = 64
"""Candidates looked at beyond the cached ones."""
LIVE_SETTLES: Final = 8
"""How many of them are simulated at most."""


class Placer:
    """Finds terminal poses in an engine's present state.

    A pose that is returned has the relation asked for, penetrates nothing, is within the robot's reach and stable: verified
    offline with nothing but its support within 5 mm, or settled now. Doors in the way are the caller's to check.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations, cache: PoseCache) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._cache = cache

    def find(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
    ) -> Pose | FailureReason:
        """Pose for a parked object on, in or under another, or why there is none.

        The order of the poses follows from ``rng``; without one it is the cache's. The world is left as it was. Raises
        EngineError for names that the engine does not know.
        """
        found = self.choices(held, target, relation, robot, rng, most=1)
        return found if isinstance(found, FailureReason) else found[0]

    def choices(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
        *,
        most: int,
    ) -> tuple[Pose, ...] | FailureReason:
        """The first poses, at least one and at most ``most``, that ``find`` would choose from, in its order."""
        if held == target or self._engine.is_parked(target):
            return FailureReason.PLACE_ON_ITSELF
        before = self._engine.pose(held)
        try:
            return self._search(held, target, relation, robot, rng, most)
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)

    def _search(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None,
        most: int,
    ) -> tuple[Pose, ...] | FailureReason:
        fails = FailureReason.NO_CAVITY if relation is Relation.INSIDE else FailureReason.NO_SURFACE
        base = self._engine.pose(target)
        if not is_upright(base):
            return fails
        good: list[Pose] = []
        cached = self._cached(held, target, relation, rng)
        for local in cached:
            found = self._accept_verified(held, target, relation, base @ local, robot)
            good += [found] if found is not None else []
            if len(good) == most:
                return tuple(good)
        settles = 0
        fresh = self._fresh(held, target, relation, rng)
        for local in fresh:
            if settles == LIVE_SETTLES:
                break
            if not self._is_free(held, base @ local, robot):
                continue
            settles += 1
            found = self._accept_settled(held, target, relation, robot)
            good += [found] if found is not None else []
            if len(good) == most:
                break
        if good:
            return tuple(good)
        return FailureReason.NO_FREE_POSE if cached or fresh else fails

    def _cached(
        self, held: str, target: str, relation: Relation, rng: np.random.Generator | None
    ) -> list[Pose]:
        key = PlacementKey(self._scene.by_name[held].asset_id, self._scene.by_name[target].asset_id, relation)
        poses = self._cache.placements.get(key, ())
        order = range(len(poses)) if rng is None else rng.permutation(len(poses)).tolist()
        return [poses[number] for number in order]

    def _fresh(
        self, held: str, target: str, relation: Relation, rng: np.random.Generator | None
    ) -> list[Pose]:
        """Unverified candidates, for pairs that the analysis did not foresee and surfaces that have filled up."""
        shift = (0.5, 0.5) if rng is None else (float(rng.random()), float(rng.random()))
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        return list(candidates(one, other, relation, shift, LIVE_TRIES))

    def _accept_verified(
        self, held: str, target: str, relation: Relation, pose: Pose, robot: StandPose
    ) -> Pose | None:
        if not self._is_free(held, pose, robot):
            return None
        alone = not self._engine.penetrates(held, UNDISTURBED_M + TOLERANCE_M, frozenset((target, FLOOR)))
        if alone and self._relations.holds(relation, held, target):
            return pose
        return self._accept_settled(held, target, relation, robot)

    def _accept_settled(self, held: str, target: str, relation: Relation, robot: StandPose) -> Pose | None:
        """Let the object go where it is and take the pose where it comes to rest, if all still holds there."""
        settled = self._engine.settle(held)
        if not settled.stable or not self._is_free(held, settled.pose, robot):
            return None
        return settled.pose if self._relations.holds(relation, held, target) else None

    def _is_free(self, held: str, pose: Pose, robot: StandPose) -> bool:
        """Put the object at the pose and tell whether it is in reach there and penetrates nothing."""
        self._engine.set_pose(held, pose)
        return in_reach(self._engine.aabb(held), robot) and not self._engine.penetrates(held)


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Whether the arm reaches the nearest point of a box in the plane, and its middle's height."""
    dx = max(box.low_m[0] - robot.x_m, robot.x_m - box.high_m[0], 0.0)
    dy = max(box.low_m[1] - robot.y_m, robot.y_m - box.high_m[1], 0.0)
    height = box.center_m[2]
    return math.hypot(dx, dy) <= ROBOT.reach_m and ROBOT.reach_low_m <= height <= ROBOT.reach_high_m
