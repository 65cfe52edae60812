"""Placing: where what is held goes, how it gets there, and whether it stays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.actions import other_stands
from embomatrix.sim.physical.fold import fold
from embomatrix.sim.physical.put import drop, put
from embomatrix.sim.physical.regrasp import regrasp
from embomatrix.sim.physical.travel import travel
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import preposition, refuse
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.sim.physical.stage import PhysicalStage
    from embomatrix.skills.syntax import PlaceRelation
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.geometry import Pose
    from embomatrix.world.poses import StandPose

PLACES: Final = 24


def place(
    stage: PhysicalStage, target: str, asked: PlaceRelation, rng: np.random.Generator
) -> SkillRefusal | None:
    """Put what the hand holds where the planning scene has room for it, and see whether it stays."""
    world, grip = stage.world, stage.grip
    assert grip is not None
    home, held = stage.told, grip.name
    relation = Relation(asked.value)
    words = {"held": held, "target": target, "relation": preposition(asked)}
    found, stand = _places(stage, target, relation, rng)
    if isinstance(found, FailureReason):
        return refuse(found, **words)
    if stand is not home:
        refusal = travel(stage, stand, target)
        if refusal is not None:
            return refusal
        home = stand

    def counts() -> bool:
        return world.relations.holds(relation, held, target)

    refusal = put(stage, found, counts, target)
    if refusal is not None and stage.grip is not None:
        fold(stage, home, target)
        if regrasp(stage, found, counts, home):
            refusal = put(stage, found, counts, target)
        if refusal is not None and stage.grip is not None:
            refusal = drop(stage, found, counts, target)
    fold(stage, home, target)
    if stage.grip is not None:
        return refusal
    stage.settle()
    if refusal is None and not counts():
        return refuse(FailureReason.FELL, **words)
    return refusal


def _places(
    stage: PhysicalStage, target: str, relation: Relation, rng: np.random.Generator
) -> tuple[tuple[Pose, ...] | FailureReason, StandPose]:
    """Poses for what is held, or why there are none, and where to stand for them: as in cached mode, here if there are any."""
    world = stage.world
    held, here = world.carried[0], stage.told
    found = world.placer.choices(held, target, relation, here, rng, most=PLACES)
    if found is FailureReason.NO_FREE_POSE:
        for stand in other_stands(world, target):
            more = world.placer.choices(held, target, relation, stand, rng, most=PLACES)
            if not isinstance(more, FailureReason):
                return more, stand
    return found, here
