"""Candidate places in the scene as loaded: what is near each of them, so that later only moved objects need a look."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.geometry.batch_poses import BoolArray, PoseBoxes, PoseSet
from embomatrix.world.geometry import Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose

NOTHING_NEAR_M: Final = 0.02
"""Objects whose boxes are further apart do not affect a placement: its tests look 1.5 cm far."""


@dataclass(frozen=True, slots=True)
class LoadedPlaces:
    """World boxes of n candidate poses on a support that is as loaded.

    ``table`` has shape (n, 7): low corner, high corner, and a 1 for each pose with no wall and no object but the support near
    it in the scene as loaded, else a 0. It is one array, because each object that a slot reads is a copied page.
    """

    table: FloatArray
    served: dict[StandPose, tuple[bool, ...]] | None = None
    """Places that the arm reaches past the open doors, as flags by standing pose; None for a shut support."""

    @property
    def boxes(self) -> PoseBoxes:
        return PoseBoxes(self.table[:, :3], self.table[:, 3:6])


def loaded_places(
    engine: PhysicsEngine,
    target: str,
    places: PoseSet,
    fractions: tuple[float, ...],
    frames: Mapping[str, Pose],
) -> LoadedPlaces:
    """Look around each pose of an object with these joint positions. Only the target may differ from the scene as loaded."""
    boxes = places.world_boxes(fractions, frames)
    lonely: BoolArray = np.ones(len(boxes.lows_m), dtype=np.bool_)
    valid = boxes.finite()
    if len(valid.lows_m):
        around = valid.around().grown(NOTHING_NEAR_M)
        others = [engine.aabb(name) for name in engine.near(around, frozenset((target,)))]
        lonely = ~boxes.meet(others, NOTHING_NEAR_M)
        if engine.is_at_static(around):
            lonely &= [not engine.is_at_static(box.grown(NOTHING_NEAR_M)) for box in boxes.each()]
    table = np.column_stack([boxes.lows_m, boxes.highs_m, lonely])
    return LoadedPlaces(table, {} if any(engine.joints(target)) else None)


class MovedObjects:
    """Objects of an engine that may not be as loaded, from its journal."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._names: set[str] = set()
        self._round, self._read = -1, 0

    def boxes(self, ignore: frozenset[str]) -> list[Aabb]:
        """Boxes of the moved objects in the world but these."""
        engine, journal = self._engine, self._engine.journal
        if journal.rounds != self._round:
            self._names.clear()
            self._round, self._read = journal.rounds, 0
        self._names.update([name for name, _ in journal.entries[self._read :]])
        self._read = len(journal.entries)
        return [engine.aabb(name) for name in self._names - ignore if not engine.is_parked(name)]
