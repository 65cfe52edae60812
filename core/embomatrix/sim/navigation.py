"""Where the robot can go, and where it stands to work on a thing.

Obstacles are walls, fixed objects and what stands on the floor, up to the robot's height. Leaves of furniture that stand
open are left out: the robot is assumed to reach and pass around them. Room doors have no leaves.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.floor_grid import CELL_M, FloorGrid, Obstacles
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.floor_grid import Cell
    from embomatrix.sim.relations import Relations
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import FloatArray, Vec2
    from embomatrix.world.scene import Room

FLAT_M: Final = 0.03
"""The robot drives over what is lower than this: rugs."""
ON_FLOOR_M: Final = 0.05
"""A movable object whose underside is lower than this stands on the floor."""
REACH_SLACK_M: Final = 0.05
"""Standing poses are this much nearer than the arm reaches, so that a thing may be a little off its box's edge."""
OVER_M: Final = 0.1
"""The arm passes over what is no more than this much higher than the thing it reaches for."""
FRONT_COSINE: Final = math.cos(math.radians(65.0))
"""What has a front is served from within 65 degrees of it."""
STANDS: Final = 8
APART_M: Final = 0.25
"""Standing poses of one thing are at least this far from one another."""
TRIED: Final = 96
SIDE_WEIGHT_M: Final = 0.4
"""Standing abeam of the front is as bad as standing this much farther away."""
ROOFED_M: Final = 1.5
"""A cavity whose floor has less free height than this can't be reached from above."""
SLACK_M: Final = 0.005
GRIDS_KEPT: Final = 8
STANDS_KEPT: Final = 4096
"""Answers in memory, about 1 KB each."""
ENTRY_M: Final = 0.4
STEP_M: Final = CELL_M / 2


class Navigator:
    """Paths and standing poses in an engine's present state. Call ``refresh`` after objects on the floor have moved."""

    def __init__(self, engine: PhysicsEngine, relations: Relations) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._numbers = {item.name: number for number, item in enumerate(self._scene.objects)}
        self._base = self._walls()
        for item in self._scene.objects:
            if item.fixed:
                self._base = self._base.joined(self._parts_of(item.name))
        self._grids: OrderedDict[tuple[object, ...], tuple[FloorGrid, Obstacles]] = OrderedDict()
        self._stands: dict[tuple[object, ...], tuple[StandPose, ...]] = {}
        self.refresh()

    def refresh(self) -> None:
        """Bring the grid up to date with the movable objects on the floor. States seen before cost a look-up."""
        standing = [item.name for item in self._scene.objects if not item.fixed and self._on_floor(item.name)]
        key = tuple((name, self._engine.pose(name)) for name in standing)
        if key not in self._grids:
            obstacles = self._base
            for name in standing:
                obstacles = obstacles.joined(self._parts_of(name))
            boxes = obstacles.boxes
            barring = (boxes[:, 4] < ROBOT.height_m) & (boxes[:, 5] > FLAT_M)
            self._grids[key] = (FloorGrid(self._scene, boxes[barring]), obstacles)
        self._grids.move_to_end(key)
        self._floor = key
        if len(self._grids) > GRIDS_KEPT:
            self._grids.popitem(last=False)
        self._grid, self._obstacles = self._grids[key]

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
        # All that the answer depends on: plans of a group ask the same again and again.
        hosts = tuple(self._hosts_of(name))
        key = (self._floor, self._grid.label(start), name, self._engine.pose(name), hosts)
        if key not in self._stands:
            if len(self._stands) == STANDS_KEPT:
                self._stands.clear()
            self._stands[key] = self._find_stands(name, start)
        return self._stands[key]

    def _find_stands(self, name: str, start: Cell) -> tuple[StandPose, ...]:
        box = self._relations.body(name)
        low, high = np.array(box.low_m[:2]), np.array(box.high_m[:2])
        reach = ROBOT.reach_m - REACH_SLACK_M
        window_low, window_high = (low - reach).tolist(), (high + reach).tolist()
        centers = self._grid.free_centers(
            (window_low[0], window_low[1]), (window_high[0], window_high[1]), self._grid.label(start)
        )
        nearest = np.clip(centers, low, high)  # (n, 2)
        away = np.linalg.norm(centers - nearest, axis=1)  # (n,)
        cosines, required = self._frontality(name, centers)
        fits = (away >= ROBOT.shoulder_m) & (away <= reach)
        if required:
            fits &= cosines >= FRONT_COSINE
        cost = np.where(fits, away + SIDE_WEIGHT_M * (1 - cosines) / 2, np.inf)
        return self._choose(name, box, centers, nearest, cost)

    def line_is_clear(self, origin: StandPose, name: str) -> bool:
        """Whether no wall nor anything much taller than the object stands between the robot and the object's box."""
        box = self._relations.body(name)
        point = np.array((origin.x_m, origin.y_m))
        nearest = np.clip(point, box.low_m[:2], box.high_m[:2])
        return not _crosses(point, nearest, self._blockers(name, box))

    def _choose(
        self, name: str, box: Aabb, centers: FloatArray, nearest: FloatArray, cost: FloatArray
    ) -> tuple[StandPose, ...]:
        """Walk through the cells by cost; keep those with a clear line that are apart from the ones kept before."""
        blockers = self._blockers(name, box)
        chosen: list[StandPose] = []
        tried = 0
        for index in np.argsort(cost, kind="stable").tolist():
            if not math.isfinite(cost[index]) or len(chosen) == STANDS or tried == TRIED:
                break
            x, y = centers[index].tolist()
            if any(math.hypot(x - other.x_m, y - other.y_m) < APART_M for other in chosen):
                continue
            tried += 1
            if _crosses(centers[index], nearest[index], blockers):
                continue
            tx, ty = nearest[index].tolist()
            chosen.append(StandPose(x, y, math.atan2(ty - y, tx - x)))
        return tuple(chosen)

    def _frontality(self, name: str, centers: FloatArray) -> tuple[FloatArray, bool]:
        """Cosines between the front and the direction to each centre, shape (n,), and whether the front is required.

        The front is that of the fixed furniture which the object stands in or on, or its own.
        """
        fixed = [host for host in self._hosts_of(name) if self._scene.by_name[host].fixed]
        yaw = self._engine.pose(fixed[0] if fixed else name).yaw
        to_robot = centers - np.array(self._relations.body(name).center_m[:2])
        to_robot /= np.maximum(np.linalg.norm(to_robot, axis=1, keepdims=True), 1e-9)
        cosines = to_robot @ np.array((math.cos(yaw), math.sin(yaw)))
        return cosines, has_front(self._scene.asset_of(name))

    def _blockers(self, name: str, box: Aabb) -> FloatArray:
        """Rectangles, shape (n, 4), that the arm can't pass on its way to a box.

        Walls and what is much taller than the object; and where a host roofs the object over, the host's own sides.
        """
        rows, owners = self._obstacles.boxes, self._obstacles.owners
        low, top = box.low_m[2], box.high_m[2]
        x, y, _ = box.center_m
        own = [self._numbers[item] for item in (name, *self._hosts_of(name))]
        barring = (rows[:, 5] > top + OVER_M) & (rows[:, 4] < max(top, ROBOT.shoulder_m))
        barring &= ~np.isin(owners, own)
        over = (
            (rows[:, 0] <= x)
            & (x <= rows[:, 2])
            & (rows[:, 1] <= y)
            & (y <= rows[:, 3])
            & (rows[:, 4] >= top)
        )
        beside = (rows[:, 4] < top - SLACK_M) & (rows[:, 5] > low + SLACK_M) & ~self._obstacles.leaves
        for number in own[1:]:
            mine = owners == number
            if (mine & over).any():
                barring |= mine & beside
        return rows[barring, :4]

    def _hosts_of(self, name: str) -> list[str]:
        """What the object stands on or in, what that stands on or in, and so on."""
        chain = [name]
        while (host := self._relations.host_of(chain[-1])) is not None and host.name not in chain:
            chain.append(host.name)
        return chain[1:]

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
        rows = [_row(wall.aabb(world)) for wall in self._scene.walls]
        return _obstacles(rows, -1, [False] * len(rows))

    def _parts_of(self, name: str) -> Obstacles:
        """Boxes of the object's parts with its joints shut."""
        pose = self._engine.pose(name)
        links = self._scene.asset_of(name).links
        rows = [_row(part.aabb(pose)) for link in links for part in link.parts]
        leaves = [link.joint is not None for link in links for _ in link.parts]
        return _obstacles(rows, self._numbers[name], leaves)


def has_front(asset: Asset) -> bool:
    """Whether a thing is served from its front only: it has doors, or cavities with a roof."""
    roofed = any(surface.interior and surface.clearance_m < ROOFED_M for surface in asset.supports)
    return bool(asset.joints) or roofed


def _obstacles(rows: Sequence[tuple[float, ...]], owner: int, leaves: Sequence[bool]) -> Obstacles:
    return Obstacles(
        np.array(rows, dtype=np.float64).reshape(-1, 6),
        np.full(len(rows), owner, dtype=np.int32),
        np.array(leaves, dtype=np.bool_),
    )


def _row(box: Aabb) -> tuple[float, ...]:
    return (*box.low_m[:2], *box.high_m[:2], box.low_m[2], box.high_m[2])


def _crosses(start: FloatArray, end: FloatArray, boxes: FloatArray) -> bool:
    """Whether the segment between two points of the plane passes through any rectangle, shape (n, 4): slab test."""
    step = end - start
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    first = (boxes[:, :2] - start) / step  # (n, 2)
    last = (boxes[:, 2:] - start) / step  # (n, 2)
    enter = np.minimum(first, last).max(axis=1)
    leave = np.maximum(first, last).min(axis=1)
    return bool(((enter < leave) & (leave > 0.0) & (enter < 1.0)).any())
