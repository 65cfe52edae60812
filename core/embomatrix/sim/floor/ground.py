"""Obstacles on the floor and the free space between them, in the scene as loaded and now."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from embomatrix.sim.caches import BoundedCache, RecentCache
from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.grid import Blocked, FloorGrid
from embomatrix.sim.floor.obstacles import WALLS, Obstacles
from embomatrix.sim.floor.open_panels import OpenJoint, OpenJoints, OpenPanels
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.geometry import IDENTITY, Pose

ON_FLOOR_M: Final = 0.05
"""A movable object with a lower underside stands on the floor."""
GRIDS_KEPT: Final = 2
"""Floor layouts in memory besides the first: a plan returns to few; each takes 1 MB in a house with a garden."""
NARROWED_KEPT: Final = 12
"""Grids with open doors and drawers in memory per layout; most of their data is shared."""
PANELS_KEPT: Final = 512
"""Objects with open panels whose blocked cells are in memory, some kB each."""

Floor = tuple[tuple[int, Pose | None], ...]
"""Movable objects whose place on the floor differs from the start: number and pose, None if no longer there."""


@dataclass(slots=True)
class FloorLayout:
    """Floor with all panels shut: obstacles, grid, and the grids with open panels."""

    obstacles: Obstacles
    grid: FloorGrid
    narrowed: RecentCache[OpenJoints, FloorGrid] = field(default_factory=lambda: RecentCache(NARROWED_KEPT))


class Ground:
    """Floor in an engine's present state. Call ``refresh`` after objects or panels on it have moved."""

    def __init__(self, engine: PhysicsEngine, prepared: PreparedScene | None = None) -> None:
        """``prepared`` was derived from this scene as loaded."""
        self._engine = engine
        self._scene = engine.scene
        self.numbers = {item.name: number for number, item in enumerate(self._scene.objects)}
        """Numbers of the scene's objects by name."""
        blocking = [item for item in self._scene.objects if item.fixed or self._on_floor(item.name)]
        self._on_floor_at_start = {self.numbers[item.name] for item in blocking if not item.fixed}
        if prepared is not None:
            obstacles, arrays = prepared.obstacles, (prepared.covered, prepared.free)
        else:
            parts = [self._parts_of(item.name, engine.pose(item.name)) for item in blocking]
            obstacles, arrays = Obstacles.joined([self._walls(), *parts]), None
        grid = FloorGrid(self._scene, obstacles.blocking, arrays)
        self.at_start = FloorLayout(obstacles, grid, RecentCache(len(self._scene.objects) + NARROWED_KEPT))
        """Floor in the scene as loaded. Read-only."""
        self._layouts: RecentCache[Floor, FloorLayout] = RecentCache(GRIDS_KEPT)
        self._moved: dict[int, Pose | None] = {}
        """Unsorted entries of ``floor``."""
        self._open_panels = OpenPanels(engine)
        self._blocked = BoundedCache(PANELS_KEPT, self._find_blocked)
        """Cells that the open panels of an object block; it needs no floor."""
        self._round, self._read = -1, 0
        self._current: FloorLayout | None = None
        self._now: FloorGrid | None = None
        self.refresh()

    def refresh(self) -> None:
        """Update the floor. States seen before cost a look-up."""
        journal = self._engine.journal
        if journal.rounds != self._round:
            self._moved.clear()
            self._open_panels.forget()
            self._round, self._read = journal.rounds, 0
        for name in dict.fromkeys([name for name, _ in journal.entries[self._read :]]):
            number = self.numbers[name]
            if self._scene.objects[number].fixed:
                self._open_panels.note(number)
            else:
                self._compare(number)
        self._read = len(journal.entries)
        self.floor: Floor = tuple(sorted(self._moved.items())) if self._moved else ()
        """Movable objects whose place on the floor differs from the start."""
        self.open_joints: OpenJoints = self._open_panels.open_now()
        """Fixed objects with open panels, and their joint positions."""
        self._current = self._now = None

    @property
    def _layout(self) -> FloorLayout:
        """Current layout, built on demand: the robot does not drive after a plan's last placement."""
        if self._current is None:
            self._current = self._layouts.get(self.floor, self._make_layout) if self.floor else self.at_start
        return self._current

    @property
    def obstacles(self) -> Obstacles:
        """Obstacles with all panels shut. Read-only."""
        return self._layout.obstacles

    @property
    def open_panels(self) -> Obstacles:
        """Doors and drawers that are open."""
        return self._open_panels.obstacles(self.open_joints)

    @property
    def shut(self) -> FloorGrid:
        """Grid with all panels shut."""
        return self._layout.grid

    @property
    def grid(self) -> FloorGrid:
        """Grid now, built on demand: many doors are shut again before the robot drives."""
        if self._now is None and not self.open_joints:
            self._now = self._layout.grid
        if self._now is None:
            self._now = self._narrowed(self._layout, self.open_joints)
        return self._now

    def warm_up(self) -> Iterator[None]:
        """Build the grid with each object's panels wide open, one object per step. Changes no answer.

        Most plans open one object, and mostly the same ones.
        """
        for joints in self._open_panels.each_open():
            self._narrowed(self.at_start, joints)
            yield

    def _narrowed(self, layout: FloorLayout, joints: OpenJoints) -> FloorGrid:
        """Grid of a layout with panels at these joint positions."""
        return layout.narrowed.get(
            joints, lambda: layout.grid.narrowed_by([block for one in joints for block in self._blocked[one]])
        )

    def _find_blocked(self, one: OpenJoint) -> list[Blocked]:
        return self.at_start.grid.blocked_by(self._open_panels.obstacles((one,)).blocking)

    def with_shut(self, number: int) -> FloorGrid:
        """Grid if one object's panels were shut."""
        return self.shut.narrowed(self.open_panels.without([number]).blocking)

    def _compare(self, number: int) -> None:
        """Record a movable object whose place on the floor differs from the start."""
        item = self._scene.objects[number]
        pose = self._engine.pose(item.name) if self._on_floor(item.name) else None
        before = item.pose_world_asset if number in self._on_floor_at_start else None
        if pose is before or pose == before:
            self._moved.pop(number, None)
        else:
            self._moved[number] = pose

    def _make_layout(self) -> FloorLayout:
        moved = [number for number, _ in self.floor]
        parts = [
            self._parts_of(self._scene.objects[number].name, pose)
            for number, pose in self.floor
            if pose is not None
        ]
        come = Obstacles.joined([Obstacles.of([], WALLS, []), *parts])
        obstacles = self.at_start.obstacles
        now = Obstacles.joined([obstacles.without(moved), come])
        return FloorLayout(now, self.at_start.grid.changed(obstacles.only(moved).blocking, come.blocking))

    def _on_floor(self, name: str) -> bool:
        return not self._engine.is_parked(name) and self._engine.aabb(name).low_m[2] < ON_FLOOR_M

    def _walls(self) -> Obstacles:
        boxes = [wall.aabb(IDENTITY) for wall in self._scene.walls]
        return Obstacles.of(boxes, WALLS, [False] * len(boxes))

    def _parts_of(self, name: str, pose: Pose) -> Obstacles:
        """Boxes of the object's parts at a pose with its joints shut."""
        asset = self._scene.asset_of(name)
        boxes = bounds_of(asset).part_boxes(pose, (0.0,) * len(asset.joints))
        panels = [link.joint is not None for link in asset.links for _ in link.parts]
        return Obstacles.of(boxes, self.numbers[name], panels)
