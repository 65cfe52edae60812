"""Physical-mode actors with known differences from the cached mode.

They are module functions because spawned processes find them by name.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from embomatrix.sim.actions import CachedActor
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill
from embomatrix.skills.view import refuse, target_of
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.bundle import Bundle


class ClumsyActor(CachedActor):
    """Actor that fails to press every switch."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        if call.skill is Skill.TOGGLE_ON:
            target = target_of(world, call)
            return refuse(FailureReason.ARM_BLOCKED, target=target, other=target)
        return super().act(world, call, rng)


class SloppyActor(CachedActor):
    """Actor that places objects correctly and then moves them to the far corner of the kitchen."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        held = world.carried[:1]
        refusal = super().act(world, call, rng)
        if call.skill is Skill.PLACE and refusal is None:
            world.engine.set_pose(held[0], Pose((4.8, 0.2, 0.5)))
        return refusal


class DyingActor(CachedActor):
    """Actor that kills its process when it opens an object."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        if call.skill is Skill.OPEN:
            os._exit(7)
        return super().act(world, call, rng)


class HangingActor(CachedActor):
    """Actor that hangs when it opens an object."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        if call.skill is Skill.OPEN:
            time.sleep(600.0)
        return super().act(world, call, rng)


class RaisingActor(CachedActor):
    """Actor that raises an error when it opens an object."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        if call.skill is Skill.OPEN:
            raise ArithmeticError("the door is not a number")
        return super().act(world, call, rng)


def clumsy(bundle: Bundle) -> Simulator:
    return load_simulator(bundle, actor=ClumsyActor())


def sloppy(bundle: Bundle) -> Simulator:
    return load_simulator(bundle, actor=SloppyActor())


def dying(bundle: Bundle) -> Simulator:
    return load_simulator(bundle, actor=DyingActor())


def hanging(bundle: Bundle) -> Simulator:
    return load_simulator(bundle, actor=HangingActor())


def raising(bundle: Bundle) -> Simulator:
    return load_simulator(bundle, actor=RaisingActor())
