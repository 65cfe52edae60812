"""What stands on the floor, and where the robot fits between it: as the scene was loaded, and as it is now."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.floor.grid import FloorGrid
from embomatrix.sim.floor.obstacles import WALLS, Obstacles
from embomatrix.sim.floor.open_panels import OpenLeaves
from embomatrix.sim.geometry.bounds import AssetParts
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.floor.open_panels import Ajar
    from embomatrix.sim.floor.prepared import PreparedScene

ON_FLOOR_M: Final = 0.05
"""A movable object whose underside is lower than this stands on the floor."""
GRIDS_KEPT: Final = 2
"""Floors in memory besides that of the start: a plan comes back to few, and each takes a megabyte in a house with a garden."""
LEAVES_KEPT: Final = 12
"""Floors with doors and drawers open in memory, for each of these: they share most with one another."""

Floor = tuple[tuple[int, Pose | None], ...]
"""Movable objects that stand on the floor otherwise than at the start: number and pose, None for what stands there no more."""


@dataclass(slots=True)
class Laid:
    """A floor with its leaves shut: what bars the way, where the robot fits, and where it does with leaves open."""

    obstacles: Obstacles
    grid: FloorGrid
    narrowed: OrderedDict[Ajar, FloorGrid]


class Ground:
    """The floor in an engine's present state. Call ``refresh`` after anything on it has moved, or a leaf."""

    def __init__(self, engine: PhysicsEngine, prepared: PreparedScene | None = None) -> None:
        """``prepared`` was found before, in this scene as it was loaded."""
        self._engine = engine
        self._scene = engine.scene
        self.numbers = {item.name: number for number, item in enumerate(self._scene.objects)}
        """Of the scene's objects, by their names."""
        self._parts: dict[str, AssetParts] = {}
        bars = [item for item in self._scene.objects if item.fixed or self._on_floor(item.name)]
        self._on_floor_at_start = {self.numbers[item.name] for item in bars if not item.fixed}
        if prepared is not None:
            obstacles = prepared.obstacles
            grid = FloorGrid.restored(self._scene, prepared.covered, prepared.free)
        else:
            obstacles = Obstacles.joined(
                [self._walls(), *(self._parts_of(item.name, engine.pose(item.name)) for item in bars)]
            )
            grid = FloorGrid(self._scene, obstacles.barring)
        self._at_start = Laid(obstacles, grid, OrderedDict())
        self._kept: OrderedDict[Floor, Laid] = OrderedDict()
        self._moved: dict[int, Pose | None] = {}
        """As ``floor`` has them, in any order."""
        self._leaves = OpenLeaves(engine)
        self._one_open: dict[Ajar, FloorGrid] = {}
        """Where the robot fits on the floor of the start with the leaves of one more object wide open."""
        self._round, self._read = -1, 0
        self._current: Laid | None = None
        self._now: FloorGrid | None = None
        self.refresh()

    def refresh(self) -> None:
        """Bring the floor up to date. States seen before cost a look-up."""
        journal = self._engine.journal
        if journal.rounds != self._round:
            self._moved.clear()
            self._leaves.forget()
            self._round, self._read = journal.rounds, 0
        for name in dict.fromkeys([name for name, _ in journal.entries[self._read :]]):
            number = self.numbers[name]
            if self._scene.objects[number].fixed:
                self._leaves.note(number)
            else:
                self._compare(number)
        self._read = len(journal.entries)
        self.floor: Floor = tuple(sorted(self._moved.items())) if self._moved else ()
        """What stands on the floor otherwise than at the start."""
        self.ajar: Ajar = self._leaves.ajar()
        """Whose leaves stand open."""
        self._current = self._now = None

    @property
    def _laid(self) -> Laid:
        """The floor as it is, made when it is asked for: after what is put down last, nobody drives."""
        if self._current is None:
            self._current = self._lay_or_recall(self.floor) if self.floor else self._at_start
        return self._current

    @property
    def obstacles(self) -> Obstacles:
        """What stands in the way, all leaves shut. For reading only."""
        return self._laid.obstacles

    @property
    def leaves(self) -> Obstacles:
        """Doors and drawers that stand open."""
        return self._leaves.obstacles(self.ajar)

    @property
    def shut(self) -> FloorGrid:
        """Where the robot would fit if all leaves were shut."""
        return self._laid.grid

    @property
    def grid(self) -> FloorGrid:
        """Where the robot fits, made when it is asked for: many doors are shut again before it drives."""
        if self._now is None and not self.ajar:
            self._now = self._laid.grid
        if self._now is None:
            foreseen = self._one_open.get(self.ajar) if self._laid is self._at_start else None
            self._now = foreseen or self._narrowed()
        return self._now

    def complete(self) -> Iterator[None]:
        """Find out where the robot fits with the leaves of each object wide open, one object at a step.

        Work for a process that waits. Changes no answer: most plans open one thing, and most of these are opened again.
        """
        for ajar in self._leaves.each_open():
            leaves = self._leaves.obstacles(ajar)
            self._one_open[ajar] = self._at_start.grid.narrowed(leaves.barring)
            yield

    def _narrowed(self) -> FloorGrid:
        """The floor with the leaves that stand open now."""
        kept = self._laid.narrowed
        if self.ajar not in kept:
            kept[self.ajar] = self.shut.narrowed(self.leaves.barring)
            if len(kept) > LEAVES_KEPT:
                kept.popitem(last=False)
        kept.move_to_end(self.ajar)
        return kept[self.ajar]

    @property
    def at_start(self) -> tuple[Obstacles, FloorGrid]:
        """``obstacles`` and ``shut`` in the scene as it was loaded. For reading only."""
        return self._at_start.obstacles, self._at_start.grid

    def with_shut(self, number: int) -> FloorGrid:
        """Where the robot would fit if the leaves of one object were shut."""
        return self.shut.narrowed(self.leaves.without([number]).barring)

    def _compare(self, number: int) -> None:
        """Note whether a movable object stands on the floor otherwise than at the start."""
        item = self._scene.objects[number]
        pose = self._engine.pose(item.name) if self._on_floor(item.name) else None
        before = item.pose_world_asset if number in self._on_floor_at_start else None
        if pose is before or pose == before:
            self._moved.pop(number, None)
        else:
            self._moved[number] = pose

    def _lay_or_recall(self, floor: Floor) -> Laid:
        if floor not in self._kept:
            self._kept[floor] = self._lay(floor)
            if len(self._kept) > GRIDS_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(floor)
        return self._kept[floor]

    def _lay(self, floor: Floor) -> Laid:
        moved = [number for number, _ in floor]
        parts = [
            self._parts_of(self._scene.objects[number].name, pose)
            for number, pose in floor
            if pose is not None
        ]
        come = Obstacles.joined([Obstacles.of([], WALLS, []), *parts])
        obstacles, grid = self.at_start
        now = Obstacles.joined([obstacles.without(moved), come])
        return Laid(now, grid.changed(obstacles.only(moved).barring, come.barring), OrderedDict())

    def _on_floor(self, name: str) -> bool:
        return not self._engine.is_parked(name) and self._engine.aabb(name).low_m[2] < ON_FLOOR_M

    def _walls(self) -> Obstacles:
        world = Pose((0.0, 0.0, 0.0))
        boxes = [wall.aabb(world) for wall in self._scene.walls]
        return Obstacles.of(boxes, WALLS, [False] * len(boxes))

    def _parts_of(self, name: str, pose: Pose) -> Obstacles:
        """Boxes of the object's parts at a pose with its joints shut."""
        asset = self._scene.asset_of(name)
        if asset.asset_id not in self._parts:
            self._parts[asset.asset_id] = AssetParts(asset)
        shut = (0.0,) * len(asset.joints)
        boxes = self._parts[asset.asset_id].boxes(pose, shut)
        leaves = [link.joint is not None for link in asset.links for _ in link.parts]
        return Obstacles.of(boxes, self.numbers[name], leaves)
