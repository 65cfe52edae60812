"""Open doors, drawers and lids of furniture, and the floor that they take.

Panels open by no more than ``OPEN_FRACTION`` take none.
"""

from collections.abc import Iterator

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.obstacles import WALLS, Obstacles
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.state import OPEN_FRACTION

OpenJoint = tuple[int, tuple[float, ...]]
"""Fixed object with an open panel: number in the scene and joint positions."""
OpenJoints = tuple[OpenJoint, ...]


class OpenPanels:
    """Panels of an engine's fixed objects. The caller reports the changed objects."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._objects = engine.scene.objects
        jointed = [number for number, item in enumerate(self._objects) if item.fixed and item.joints]
        self._jointed = frozenset(jointed)
        self._at_start = frozenset(number for number in jointed if any(self._objects[number].joints))
        self._moved = set(self._at_start)
        self._open: OpenJoints | None = None
        """Objects that are open, until the next change."""

    def forget(self) -> None:
        """Forget all changes after a reset of the engine."""
        self._moved = set(self._at_start)
        self._open = None

    def note(self, number: int) -> None:
        """Record that the object of this number has changed."""
        if number in self._jointed:
            self._moved.add(number)
            self._open = None

    def open_now(self) -> OpenJoints:
        """Objects that are open now, in scene order."""
        if self._open is None:
            joints = [
                (number, self._engine.joints(self._objects[number].name)) for number in sorted(self._moved)
            ]
            self._open = tuple(
                (number, fractions) for number, fractions in joints if max(fractions) > OPEN_FRACTION
            )
        return self._open

    def each_open(self) -> Iterator[OpenJoints]:
        """Initially open objects plus one more with all its joints wide open, for each object in turn."""
        at_start = {number: tuple(self._objects[number].joints) for number in self._at_start}
        for number in sorted(self._jointed):
            joints = at_start | {number: (1.0,) * len(self._objects[number].joints)}
            yield tuple(
                (other, fractions)
                for other, fractions in sorted(joints.items())
                if max(fractions) > OPEN_FRACTION
            )

    def obstacles(self, joints: OpenJoints) -> Obstacles:
        """Boxes of the panels that are open at these joint positions."""
        found = [Obstacles.of([], WALLS, [])]
        for number, fractions in joints:
            item = self._objects[number]
            asset = self._engine.scene.asset_of(item.name)
            boxes = bounds_of(asset).part_boxes(self._engine.pose(item.name), fractions)
            moving = iter(fractions)
            shares = [next(moving) if link.joint is not None else 0.0 for link in asset.links]
            of_parts = [share for link, share in zip(asset.links, shares, strict=True) for _ in link.parts]
            out = [box for box, share in zip(boxes, of_parts, strict=True) if share > OPEN_FRACTION]
            found.append(Obstacles.of(out, number, [True] * len(out)))
        return Obstacles.joined(found)
