"""Where something changed since one looked last: for sources, which act again only where there is news."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.geometry import Aabb


class News:
    """Reads an engine's journal. A reset is no news: what follows it is."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._round = engine.journal.rounds
        self._read = 0
        self._places: dict[str, list[Aabb]] = {}

    def read(self) -> bool:
        """Go on to what changed since the last call. Whether the engine was reset in between."""
        journal = self._engine.journal
        again = journal.rounds != self._round
        if again:
            self._round, self._read = journal.rounds, 0
        self._places.clear()
        for name, box in journal.entries[self._read :]:
            if name not in self._places:
                self._places[name] = [box] if box is not None else []
        self._read = len(journal.entries)
        for name, boxes in self._places.items():
            if not self._engine.is_parked(name):
                boxes.append(self._engine.aabb(name))
        return again

    def concerns(self, name: str, area: Aabb) -> bool:
        """Whether the object is among what changed, or anything in an area before or after it changed."""
        places = self._places
        return bool(places) and (
            name in places or any(area.overlaps(box) for boxes in places.values() for box in boxes)
        )
