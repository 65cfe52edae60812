"""Where the robot can go, and where it stands to work on a thing.

Obstacles are walls, fixed objects and what stands on the floor, up to the robot's height. Leaves of furniture that stand
open are left out: the robot is assumed to reach and pass around them. Room doors have no leaves.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bounds import AssetParts
from embomatrix.sim.floor_grid import CELL_M, FloorGrid
from embomatrix.sim.obstacles import WALLS, Obstacles, crosses
from embomatrix.sim.standing import Service
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.floor_grid import Cell
    from embomatrix.sim.prepared import Prepared
    from embomatrix.sim.relations import Relations
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import FloatArray, Vec2
    from embomatrix.world.scene import Room

ON_FLOOR_M: Final = 0.05
"""A movable object whose underside is lower than this stands on the floor."""
ROOFED_M: Final = 1.5
"""A cavity whose floor has less free height than this can't be reached from above."""
GRIDS_KEPT: Final = 3
"""Floors in memory: a plan comes back to few of them, and each takes a megabyte in a house with a garden."""
ANSWERS_KEPT: Final = 4096
"""Standing poses and rectangles in memory, a few KB each."""
ENTRY_M: Final = 0.4
STEP_M: Final = CELL_M / 2


Floor = tuple[tuple[int, Pose | None], ...]
"""Movable objects that stand on the floor otherwise than at the start: number and pose, None for what stands there no more."""


class Navigator:
    """Paths and standing poses in an engine's present state. Call ``refresh`` after objects on the floor have moved."""

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        stands: Mapping[str, tuple[StandPose, ...]] | None = None,
        prepared: Prepared | None = None,
    ) -> None:
        """``stands`` and ``prepared`` were found before, in this scene as it was loaded."""
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._numbers = {item.name: number for number, item in enumerate(self._scene.objects)}
        self._parts: dict[str, AssetParts] = {}
        bars = [item for item in self._scene.objects if item.fixed or self._on_floor(item.name)]
        self._on_floor_at_start = {self._numbers[item.name] for item in bars if not item.fixed}
        if prepared is not None:
            self._all_at_start = prepared.obstacles
            self._grid_at_start = FloorGrid.restored(self._scene, prepared.covered, prepared.free)
        else:
            parts = (self._parts_of(item.name) for item in bars)
            self._all_at_start = Obstacles.joined([self._walls(), *parts])
            self._grid_at_start = FloorGrid(self._scene, self._all_at_start.barring)
        self._grids: OrderedDict[Floor, tuple[FloorGrid, Obstacles]] = OrderedDict()
        self._stands: dict[tuple[object, ...], tuple[StandPose, ...]] = {}
        self._blockers: dict[tuple[object, ...], FloatArray] = {}
        self._found_before = stands if stands is not None else {}
        self._moved: set[int] = set()
        self._round, self._read = -1, 0
        self.refresh()

    def refresh(self) -> None:
        """Bring the grid up to date with the movable objects on the floor. States seen before cost a look-up."""
        journal = self._engine.journal
        if journal.rounds != self._round:
            self._moved.clear()
            self._round, self._read = journal.rounds, 0
        for name, _ in journal.entries[self._read :]:
            if not self._scene.by_name[name].fixed:
                self._moved.add(self._numbers[name])
        self._read = len(journal.entries)
        floor = tuple(self._difference())
        if floor not in self._grids:
            self._grids[floor] = self._grid_of(floor)
            if len(self._grids) > GRIDS_KEPT:
                self._grids.popitem(last=False)
        self._grids.move_to_end(floor)
        self._floor = floor
        self._grid, self._obstacles = self._grids[floor]

    def _difference(self) -> Iterator[tuple[int, Pose | None]]:
        """Movable objects that stand on the floor otherwise than at the start, in scene order; None: no more."""
        for number in sorted(self._moved):
            item = self._scene.objects[number]
            pose = self._engine.pose(item.name) if self._on_floor(item.name) else None
            if pose != (item.pose_world_asset if number in self._on_floor_at_start else None):
                yield number, pose

    def _grid_of(self, floor: Floor) -> tuple[FloorGrid, Obstacles]:
        if not floor:
            return self._grid_at_start, self._all_at_start
        moved = [number for number, _ in floor]
        names = [self._scene.objects[number].name for number, pose in floor if pose is not None]
        come = Obstacles.joined([Obstacles.of([], WALLS, []), *map(self._parts_of, names)])
        gone = self._all_at_start.only(moved)
        now = Obstacles.joined([self._all_at_start.without(moved), come])
        return self._grid_at_start.changed(gone.barring, come.barring), now

    @property
    def at_start(self) -> tuple[Obstacles, FloorGrid]:
        """What stands in the way in the scene as it was loaded, and where the robot may be. For reading only."""
        return self._all_at_start, self._grid_at_start

    @property
    def present(self) -> tuple[Obstacles, FloorGrid]:
        """What stands in the way now, and where the robot may be. For reading only."""
        return self._obstacles, self._grid

    def crossing(self, origin: StandPose, low_m: Vec2, high_m: Vec2) -> FloatArray:
        """Where the way into a rectangle that crosses the least of what stands on the floor crosses it, shape (n, 2)."""
        start = self._cell(origin)
        if start is None:
            return np.zeros((0, 2))
        floor = FloorGrid(self._scene, self._obstacles.only([WALLS]).barring).free
        return self._grid.crossing(start, low_m, high_m, floor)

    @property
    def start(self) -> StandPose:
        """Where the scene says that the robot starts."""
        robot = self._scene.robot
        return StandPose(robot.x_m, robot.y_m, robot.yaw)

    def reachable(self, origin: StandPose, target: StandPose) -> bool:
        """Whether a free path leads from one pose to the other."""
        first, last = self._cell(origin), self._cell(target)
        return first is not None and last is not None and self._grid.label(first) == self._grid.label(last)

    def path_length(self, origin: StandPose, target: StandPose) -> float | None:
        """Metres of the shortest path, None when there is none. Fields are kept by target: ask for few of them."""
        first, last = self._cell(origin), self._cell(target)
        if first is None or last is None:
            return None
        return self._grid.distance(first, last)

    def path(self, origin: StandPose, target: StandPose) -> tuple[Vec2, ...]:
        """Corners of a short free path from one pose to the other, without both ends; empty where none leads there."""
        first, last = self._cell(origin), self._cell(target)
        if first is None or last is None:
            return ()
        return (self._grid.path(first, last) or ())[1:-1]

    def spots(self, low_m: Vec2, high_m: Vec2, origin: StandPose) -> FloatArray:
        """Middles of the free cells in a rectangle that a path leads to, shape (n, 2)."""
        start = self._cell(origin)
        return self._grid.free_centers(low_m, high_m, self._grid.label(start) if start is not None else 0)

    def forward(self, origin: StandPose, yaw: float, distance_m: float) -> float:
        """How far of ``distance_m`` the robot gets from ``origin`` along the heading ``yaw`` before it meets something."""
        dx, dy = math.cos(yaw), math.sin(yaw)
        steps = max(1, math.ceil(distance_m / STEP_M))
        reached = 0.0
        for number in range(1, steps + 1):
            ahead = min(number * STEP_M, distance_m)
            if not self._grid.is_free(origin.x_m + dx * ahead, origin.y_m + dy * ahead):
                break
            reached = ahead
        return reached

    def room_entry(self, room: str, origin: StandPose) -> StandPose | None:
        """A free pose just inside the room, facing its middle, that a path from ``origin`` leads to; None without one.

        From within the room it is ``origin`` itself. Raises KeyError for an unknown room.
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
        centers = self._grid.free_centers(low, high, self._grid.label(start))
        if not len(centers):
            return None
        doors = np.array(self._doors_of(target))  # (d, 2)
        away = np.linalg.norm(centers[:, None] - doors[None], axis=2).min(axis=1)  # (n,)
        x, y = centers[int(np.argmin(away))].tolist()
        return StandPose(x, y, math.atan2(target.center_m[1] - y, target.center_m[0] - x))

    def stands(self, name: str, origin: StandPose) -> tuple[StandPose, ...]:
        """Up to eight poses from which the robot reaches the object, the nearest and most frontal first.

        Each is free, connected to ``origin``, between the shoulder's and the arm's reach from the object's box, faces it, and
        no wall nor anything much taller than the object stands between; nor, for things in furniture, its sides or back.
        What has doors or roofed cavities is served from its front.
        """
        start = self._cell(origin)
        if start is None or self._engine.is_parked(name):
            return ()
        key = self._key(name)
        if self._floor == () and self._is_as_loaded(name) and self._serves_start(start):
            found = self._found_before.get(name)
            if found is not None:
                return found
        label = self._grid.label(start)
        if (key, label) not in self._stands:
            if len(self._stands) == ANSWERS_KEPT:
                self._stands.clear()
            self._stands[key, label] = self._find_stands(name, start)
        return self._stands[key, label]

    def _find_stands(self, name: str, start: Cell) -> tuple[StandPose, ...]:
        service = self.service(name)
        low, high = service.window
        return service.stands(self._grid.free_centers(low, high, self._grid.label(start)))

    def complete(self) -> Iterator[None]:
        """Find out what bars the arm's way to each object, one at a step: work for a process that waits. Changes no answer."""
        for item in self._scene.objects:
            self._blockers_of(item.name)
            yield

    def service(self, name: str) -> Service:
        """What a place must offer from which the robot works on the object."""
        # The front is that of the fixed furniture which the object stands in or on, or its own.
        fixed = [host for host in self._relations.hosts_of(name) if self._scene.by_name[host].fixed]
        yaw = self._engine.pose(fixed[0] if fixed else name).yaw
        from_front = has_front(self._scene.asset_of(name))
        return Service(self._relations.body(name), yaw, from_front, self._blockers_of(name))

    def line_is_clear(self, origin: StandPose, name: str) -> bool:
        """Whether no wall nor anything much taller than the object stands between the robot and the object's box."""
        box = self._relations.body(name)
        (low_x, low_y, _), (high_x, high_y, _) = box.low_m, box.high_m
        here = (origin.x_m, origin.y_m)
        nearest = (min(max(origin.x_m, low_x), high_x), min(max(origin.y_m, low_y), high_y))
        near = math.dist(here, nearest) <= ROBOT.reach_m
        return not crosses(here, nearest, self._blockers_of(name) if near else self._all_blockers_of(name))

    def _blockers_of(self, name: str) -> FloatArray:
        """Those rectangles within reach of the object that the arm can't pass on its way to it, shape (4, n)."""
        key = self._key(name)
        if key not in self._blockers:
            if len(self._blockers) == ANSWERS_KEPT:
                self._blockers.clear()
            found, box = self._all_blockers_of(name), self._relations.body(name).grown(ROBOT.reach_m)
            near = (found[0] <= box.high_m[0]) & (found[2] >= box.low_m[0])
            near &= (found[1] <= box.high_m[1]) & (found[3] >= box.low_m[1])
            self._blockers[key] = np.ascontiguousarray(found[:, near])
        return self._blockers[key]

    def _all_blockers_of(self, name: str) -> FloatArray:
        own = [self._numbers[item] for item in (name, *self._relations.hosts_of(name))]
        return self._obstacles.blockers(self._relations.body(name), own)

    def _key(self, name: str) -> tuple[object, ...]:
        """All that standing poses and lines of approach depend on, but for where the robot is."""
        hosts = tuple(self._relations.hosts_of(name))
        return self._floor, name, self._engine.pose(name), hosts

    def _is_as_loaded(self, name: str) -> bool:
        """Whether the object and what it stands on or in are where the scene has them."""
        return all(
            self._engine.pose(item) == self._scene.by_name[item].pose_world_asset
            for item in (name, *self._relations.hosts_of(name))
        )

    def _serves_start(self, cell: Cell) -> bool:
        """Whether a path leads from a cell to where the scene has the robot start."""
        start = self._cell(self.start)
        return start is not None and self._grid.label(start) == self._grid.label(cell)

    def _cell(self, pose: StandPose) -> Cell | None:
        return self._grid.cell(pose.x_m, pose.y_m)

    def _doors_of(self, room: Room) -> list[tuple[float, float]]:
        doors = [
            item.center_m for item in self._scene.doorways if room.name in item.rooms and all(item.rooms)
        ]
        return doors or [room.center_m]

    def _on_floor(self, name: str) -> bool:
        return not self._engine.is_parked(name) and self._engine.aabb(name).low_m[2] < ON_FLOOR_M

    def _walls(self) -> Obstacles:
        world = Pose((0.0, 0.0, 0.0))
        boxes = [wall.aabb(world) for wall in self._scene.walls]
        return Obstacles.of(boxes, WALLS, [False] * len(boxes))

    def _parts_of(self, name: str) -> Obstacles:
        """Boxes of the object's parts with its joints shut."""
        asset = self._scene.asset_of(name)
        if asset.asset_id not in self._parts:
            self._parts[asset.asset_id] = AssetParts(asset)
        shut = (0.0,) * len(asset.joints)
        boxes = self._parts[asset.asset_id].boxes(self._engine.pose(name), shut)
        leaves = [link.joint is not None for link in asset.links for _ in link.parts]
        return Obstacles.of(boxes, self._numbers[name], leaves)


def has_front(asset: Asset) -> bool:
    """Whether a thing is served from its front only: it has doors, or cavities with a roof."""
    roofed = any(surface.interior and surface.clearance_m < ROOFED_M for surface in asset.supports)
    return bool(asset.joints) or roofed
