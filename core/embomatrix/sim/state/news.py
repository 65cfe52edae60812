"""Where something changed since one looked last: for sources, which act again only where there is news."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.geometry import Aabb


class News:
    """Reads an engine's journal. A reset is no news: what follows it is."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self.again = False
        """Whether the engine was reset between the last two looks."""
        self._engine = engine
        self._round = engine.journal.rounds
        self._read = 0
        self._names: set[str] = set()
        self._places: list[Aabb] = []

    def read(self) -> None:
        """Go on to what changed since the last call."""
        journal = self._engine.journal
        self.again = journal.rounds != self._round
        if self.again:
            self._round, self._read = journal.rounds, 0
        names = self._names = set[str]()
        self._places.clear()
        for name, box in journal.entries[self._read :]:
            if name not in names:
                names.add(name)
                if box is not None:
                    self._places.append(box)
        self._read = len(journal.entries)
        self._places += [self._engine.aabb(name) for name in names if not self._engine.is_parked(name)]

    def concerns(self, name: str, area: Aabb) -> bool:
        """Whether the object is among what changed, or anything in an area before or after it changed."""
        return name in self._names or any(area.overlaps(box) for box in self._places)
