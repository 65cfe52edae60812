"""Paths and standing poses of the robot.

Obstacles are walls, fixed objects, objects on the floor, and open doors and drawers, up to the robot's height. Room doors have
no panels.
"""

import functools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import numpy as np

from embomatrix.sim.caches import BoundedCache
from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.grid import CELL_M, FloorGrid
from embomatrix.sim.floor.ground import Floor, Ground
from embomatrix.sim.floor.obstacles import WALLS, crosses
from embomatrix.sim.floor.open_panels import OpenJoints
from embomatrix.sim.floor.paths import Cell
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.floor.standing import StandingArea
from embomatrix.sim.geometry.behind_panels import reaches_in
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Aabb, FloatArray, Pose, Vec2
from embomatrix.world.poses import StandPose
from embomatrix.world.scene import Room, Scene

ROOFED_M: Final = 1.5
"""A cavity with less free height above its floor can't be reached from above."""
ANSWERS_KEPT: Final = 4096
"""Standing poses and rectangles in memory, a few kB each."""
ENTRY_M: Final = 0.4
STEP_ASIDE_M: Final = (0.45, 0.9, 1.6)
"""Distances within which the robot steps aside from an opened panel, tried in this order."""
STEP_M: Final = CELL_M / 2


Surroundings = tuple[Floor, str, Pose, tuple[str, ...]]
"""Layout of the floor, and an object with its pose and its hosts."""


class Navigator:
    """Paths and standing poses in an engine's present state. Call ``refresh`` after objects on the floor have moved."""

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        stands: Mapping[str, tuple[StandPose, ...]] | None = None,
        prepared: PreparedScene | None = None,
    ) -> None:
        """``stands`` and ``prepared`` were derived from this scene as loaded."""
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self.ground = Ground(engine, prepared)
        """Current obstacles. Read-only."""
        self._stands = BoundedCache(ANSWERS_KEPT, self._find_stands)
        self._asides = BoundedCache(ANSWERS_KEPT, self._find_aside)
        self._blockers = BoundedCache(ANSWERS_KEPT, self._find_blockers)
        self._blockers_at_start: dict[str, FloatArray] = {}
        """Blockers of objects that are as loaded, by name: a look-up costs less than by all that they depend on."""
        self._found_before = stands if stands is not None else {}

    def refresh(self) -> None:
        """Update the ground after objects on the floor or panels have moved."""
        self.ground.refresh()

    def crossing(self, origin: StandPose, low_m: Vec2, high_m: Vec2) -> FloatArray:
        """Blocked points on the path into a rectangle that crosses the fewest obstacles, shape (n, 2)."""
        start = self._cell(origin)
        if start is None:
            return np.zeros((0, 2))
        floor = FloorGrid(self._scene, self.ground.obstacles.only([WALLS]).blocking).free
        return self.ground.grid.crossing(start, low_m, high_m, floor)

    @property
    def start(self) -> StandPose:
        """Start of the robot in the scene."""
        robot = self._scene.robot
        return StandPose(robot.x_m, robot.y_m, robot.yaw)

    def path(self, origin: StandPose, target: StandPose) -> tuple[Vec2, ...]:
        """Corners of a short free path between two poses, both excluded; empty for no path."""
        first, last = self._cell(origin), self._cell(target)
        if first is None or last is None:
            return ()
        return (self.ground.grid.path(first, last) or ())[1:-1]

    def forward(self, origin: StandPose, yaw: float, distance_m: float) -> float:
        """Distance, up to ``distance_m``, that the robot can drive from ``origin`` along the heading ``yaw``."""
        dx, dy = math.cos(yaw), math.sin(yaw)
        steps = max(1, math.ceil(distance_m / STEP_M))
        reached = 0.0
        for number in range(1, steps + 1):
            ahead = min(number * STEP_M, distance_m)
            if not self.ground.grid.is_free(origin.x_m + dx * ahead, origin.y_m + dy * ahead):
                break
            reached = ahead
        return reached

    def room_entry(self, room: str, origin: StandPose) -> StandPose | None:
        """Free pose just inside the room, facing its middle and reachable from ``origin``; None for none.

        Returns ``origin`` if it is inside the room. Raises KeyError for an unknown room.
        """
        target = {item.name: item for item in self._scene.rooms}[room]
        if target.contains(origin.x_m, origin.y_m):
            return origin
        start = self._cell(origin)
        if start is None:
            return None
        inset = min(ENTRY_M, min(target.size_m) / 4)
        low = (target.low_m[0] + inset, target.low_m[1] + inset)
        high = (target.high_m[0] - inset, target.high_m[1] - inset)
        centers = self.ground.grid.free_centers(low, high, self.ground.grid.label(start))
        if not len(centers):
            return None
        doors = np.array(_doors_of(self._scene, target))  # (d, 2)
        away = np.linalg.norm(centers[:, None] - doors[None], axis=2).min(axis=1)  # (n,)
        x, y = centers[int(np.argmin(away))].tolist()
        return StandPose(x, y, math.atan2(target.center_m[1] - y, target.center_m[0] - x))

    def stands(self, name: str, origin: StandPose) -> tuple[StandPose, ...]:
        """Up to eight poses from which the robot reaches the object, the nearest and most frontal first.

        Each pose is free, connected to ``origin``, faces the object, and is between the shoulder's and the arm's reach from
        its box. No wall nor anything much taller than the object stands between, nor the sides or back of its furniture.
        Objects with doors or roofed cavities are served from their front; with a door open, from where the arm reaches in past
        it, if there is such a place.
        """
        return tuple(self._stands_from(name, origin))

    def nearest_stand(self, name: str, origin: StandPose) -> StandPose | None:
        """First of ``stands``; None for none."""
        return next(self._stands_from(name, origin), None)

    def _stands_from(self, name: str, origin: StandPose) -> Iterator[StandPose]:
        """Yield ``stands`` lazily: driving to an object takes the first only."""
        start = self._cell(origin)
        if start is None or self._engine.is_parked(name):
            return
        ground, grid = self.ground, self.ground.grid
        if grid is ground.shut:
            yield from self._stands_on_shut(name, start)
            return
        label = grid.label(start)
        number = ground.numbers[name]
        if any(number == other for other, _ in ground.open_joints):
            yield from self._stands[self._key(name), ground.open_joints, label]
            return
        found = False
        # A cell that is free with panels open is free with all panels shut.
        for stand in self._stands_on_shut(name, start):
            if grid.label_at(stand.x_m, stand.y_m) == label:
                found = True
                yield stand
        if not found:
            yield from self._stands[self._key(name), ground.open_joints, label]

    def stands_past_shut(self, name: str, origin: StandPose) -> tuple[StandPose, ...]:
        """Evaluate ``stands`` as if all doors and drawers were shut: few panels block any of these places."""
        start = self.ground.shut.cell(origin.x_m, origin.y_m)
        if start is None or self._engine.is_parked(name):
            return ()
        return self._stands_on_shut(name, start)

    def _stands_on_shut(self, name: str, start: Cell) -> tuple[StandPose, ...]:
        """Evaluate ``stands_past_shut`` for an object in the world, from a free cell."""
        label = self.ground.shut.label(start)
        found = self._found_before.get(name) if label == self._part_of_start else None
        if found is not None and self.is_as_loaded(name) and self._is_untouched(name):
            return found
        return self._stands[self._key(name), (), label]

    def _is_untouched(self, name: str) -> bool:
        """Return True if changes on the floor left the object's standing area and the arm's access unchanged."""
        if self.ground.floor == ():
            return True
        before, area = self.ground.at_start, self.standing_area(name)
        if not self.ground.shut.is_like(before.grid, *area.window):
            return False
        blockers = before.obstacles.blockers(area.box, self._own(name))
        return np.array_equal(_within_reach(blockers, area.box), area.blockers)

    def _find_stands(self, key: tuple[Surroundings, OpenJoints, int]) -> tuple[StandPose, ...]:
        """Standing poses on one component of the current grid, or of the grid with all panels shut."""
        (_, name, pose, _), open_joints, label = key
        grid, area = self.ground.grid if open_joints else self.ground.shut, self.standing_area(name)
        centers = grid.free_centers(*area.window, label)
        fractions = dict(open_joints).get(self.ground.numbers[name])
        if fractions is not None:
            found = area.stands(centers[reaches_in(centers, self._scene.asset_of(name), pose, fractions)])
            if found:
                return found
        return area.stands(centers)

    def step_aside(self, name: str, origin: StandPose) -> StandPose:
        """Pose to serve an object near ``origin``: ``origin`` itself unless a panel takes its place or cuts it off.

        Returns ``origin`` if no other place exists.
        """
        if not self.ground.grid.may_differ_at(self.ground.shut, origin.x_m, origin.y_m):
            return origin
        return self._asides[self.ground.floor, name, self._engine.pose(name), self.ground.open_joints, origin]

    def _find_aside(self, key: tuple[Floor, str, Pose, OpenJoints, StandPose]) -> StandPose:
        _, name, _, _, origin = key
        grid, area = self.ground.grid, self.standing_area(name)
        main = grid.main_part_of(self.ground.shut, origin.x_m, origin.y_m)
        if grid.label_at(origin.x_m, origin.y_m) == main:
            return origin
        for away in STEP_ASIDE_M:
            low, high = (origin.x_m - away, origin.y_m - away), (origin.x_m + away, origin.y_m + away)
            found = area.nearest(grid.free_centers(low, high, main), origin)
            if found is not None and math.hypot(found.x_m - origin.x_m, found.y_m - origin.y_m) <= away:
                return found
        return origin

    def warm_up(self) -> Iterator[None]:
        """Compute the obstacles of the arm to each object, and the grids with open doors, one per step. Changes no answer."""
        for item in self._scene.objects:
            self._near_blockers_of(item.name)
            yield
        yield from self.ground.warm_up()

    def standing_area(self, name: str) -> StandingArea:
        """Area from which the robot works on the object."""
        # The front is that of the fixed furniture that holds the object, or its own.
        fixed = [host for host in self._relations.hosts_of(name) if self._scene.by_name[host].fixed]
        yaw = self._engine.pose(fixed[0] if fixed else name).yaw
        from_front = has_front(self._scene.asset_of(name))
        return StandingArea(self._relations.body(name), yaw, from_front, self._near_blockers_of(name))

    def line_is_clear(self, origin: StandPose, name: str) -> bool:
        """Return True if no wall nor anything much taller than the object stands between it and the robot."""
        box = self._relations.body(name)
        here, nearest = _line(origin, box)
        if math.dist(here, nearest) > ROBOT.reach_m:
            return not crosses(here, nearest, self._all_blockers_of(name))
        return not crosses(here, nearest, self._near_blockers_of(name))

    def line_would_be_clear(self, origin: StandPose, box: Aabb, own: Iterable[str]) -> bool:
        """Evaluate ``line_is_clear`` for an object that is not there yet: ``own`` are its name and its would-be hosts."""
        numbers = [self.ground.numbers[name] for name in own]
        return not self.ground.obstacles.block_line(*_line(origin, box), box, numbers)

    def is_as_loaded(self, name: str) -> bool:
        """Return True if the object and its hosts are where the scene has them."""
        return self._relations.are_untouched(name) or all(
            self._engine.pose(item) == self._scene.by_name[item].pose_world_asset
            for item in (name, *self._relations.hosts_of(name))
        )

    def _find_blockers(self, key: Surroundings) -> FloatArray:
        """Rectangles within reach of an object that block the arm on its way to it, shape (4, n)."""
        _, name, *_ = key
        return _within_reach(self._all_blockers_of(name), self._relations.body(name))

    def _near_blockers_of(self, name: str) -> FloatArray:
        """Rectangles within reach of an object that block the arm on its way to it, shape (4, n)."""
        if self.ground.floor or not self._relations.are_untouched(name):
            return self._blockers[self._key(name)]
        known = self._blockers_at_start.get(name)
        if known is None:
            known = self._blockers_at_start[name] = self._blockers[self._key(name)]
        return known

    def _all_blockers_of(self, name: str) -> FloatArray:
        return self.ground.obstacles.blockers(self._relations.body(name), self._own(name))

    def _own(self, name: str) -> list[int]:
        """Numbers of the object and its hosts."""
        return [self.ground.numbers[item] for item in (name, *self._relations.hosts_of(name))]

    def _key(self, name: str) -> Surroundings:
        """Cache key of standing poses and lines of approach, without the robot's position."""
        return self.ground.floor, name, self._engine.pose(name), self._relations.hosts_of(name)

    @functools.cached_property
    def _part_of_start(self) -> int:
        """Component of the initial floor at the robot's start; 0 for none."""
        grid = self.ground.at_start.grid
        start = grid.cell(self.start.x_m, self.start.y_m)
        return grid.label(start) if start is not None else 0

    def _cell(self, pose: StandPose) -> Cell | None:
        return self.ground.grid.cell(pose.x_m, pose.y_m)


def _doors_of(scene: Scene, room: Room) -> list[tuple[float, float]]:
    """Middles of a room's inner doorways; the room's own middle for none."""
    doors = [item.center_m for item in scene.doorways if room.name in item.rooms and all(item.rooms)]
    return doors or [room.center_m]


def _line(origin: StandPose, box: Aabb) -> tuple[Vec2, Vec2]:
    """Robot position and the box's nearest point to it, in the plane."""
    (low_x, low_y, _), (high_x, high_y, _) = box.low_m, box.high_m
    x, y = origin.x_m, origin.y_m
    return (x, y), (min(max(x, low_x), high_x), min(max(y, low_y), high_y))


def _within_reach(rectangles: FloatArray, box: Aabb) -> FloatArray:
    """Rectangles, shape (4, n), within the arm's reach of a box."""
    around = box.grown(ROBOT.reach_m)
    near = (rectangles[0] <= around.high_m[0]) & (rectangles[2] >= around.low_m[0])
    near &= (rectangles[1] <= around.high_m[1]) & (rectangles[3] >= around.low_m[1])
    return np.ascontiguousarray(rectangles[:, near])


def has_front(asset: Asset) -> bool:
    """Return True if an object is served from its front only: it has doors, or boards and cavities with a roof."""
    roofed = any(surface.walled and surface.clearance_m < ROOFED_M for surface in asset.supports)
    return bool(asset.joints) or roofed
