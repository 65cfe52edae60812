"""Actions of cached mode: each skill instantiates a verified outcome without stepping physics.

The executor checks the preconditions beforehand.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.blockers import (
    arm_refusal,
    no_place_refusal,
    obstacle_in_words,
    path_refusal,
    placing_refusal,
    room_refusal,
)
from embomatrix.sim.household import clean, cut, soak
from embomatrix.sim.joints.panels import DoorPanels
from embomatrix.sim.joints.swings import SWING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.view import SkillRefusal, metres, preposition, refuse, target_of
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import Handling, StandPose
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld

    Action = Callable[[LiveWorld, SkillCall, np.random.Generator], SkillRefusal | None]

OTHER_STANDS: Final = 2
APART_M: Final = 0.4
"""Largest number and smallest distance of other standing poses that serve a crowded support."""


class CachedActor:
    """Cached execution mode. Stateless: outcomes found offline are instantiated in the world."""

    drawing = frozenset({Skill.PLACE, Skill.SLICE})
    keeps_state = False

    def reset(self, world: LiveWorld) -> None:
        """Do nothing: the world holds all state."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        """Carry out a call whose preconditions hold. A refusal leaves the world unchanged."""
        handling = HANDLINGS.get(call.skill)
        refusal = arm_refusal(world, handling, target_of(world, call)) if handling is not None else None
        return refusal or ACTIONS[call.skill](world, call, rng)

    def close(self) -> None:
        """Do nothing."""


def _move(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    stand = world.navigator.nearest_stand(target, world.robot)
    if stand is None:
        return path_refusal(world, target)
    world.robot = stand
    return None


def _turn(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.robot = StandPose(world.robot.x_m, world.robot.y_m, heading_after(world.robot.yaw, call))
    return None


def _move_forward(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    heading, distance_m = heading_after(world.robot.yaw, call), call.distance or 0.0
    course = heading if distance_m >= 0 else heading + math.pi
    free_m = world.navigator.forward(world.robot, course, abs(distance_m))
    if free_m < abs(distance_m):
        return refuse(FailureReason.BLOCKED, distance=metres(free_m))
    x = world.robot.x_m + math.cos(course) * abs(distance_m)
    y = world.robot.y_m + math.sin(course) * abs(distance_m)
    world.robot = StandPose(x, y, heading)
    return None


def heading_after(yaw: float, call: SkillCall) -> float:
    """Heading after the call's turn from a heading, in [-pi, pi]."""
    return math.remainder(yaw + math.remainder(call.yaw or 0.0, math.tau), math.tau)


def _go_to_room(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    room = call.room_name or ""
    entry = world.navigator.room_entry(room, world.robot)
    if entry is None:
        return room_refusal(world, room)
    world.robot = entry
    return None


def _pick_up(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.hand.take(world.cargo(target_of(world, call)))
    world.navigator.refresh()
    return None


def _place(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    assert call.relation is not None
    target, held = target_of(world, call), world.carried[0]
    relation = Relation(call.relation.value)
    refusal = placing_refusal(world, held, target, relation)
    if refusal is not None:
        return refusal
    tried: tuple[StandPose, ...] = ()
    for stand in itertools.chain((world.robot,), other_stands(world, target)):
        found = world.placer.find(held, target, relation, stand, rng, tried)
        if isinstance(found, Pose) and world.hand.let_go(found):
            world.robot = stand
            world.navigator.refresh()
            return None
        if isinstance(found, FailureReason) and found is not FailureReason.NO_FREE_POSE:
            return refuse(found, held=held, target=target, relation=preposition(call.relation))
        tried = (*tried, stand)
    return no_place_refusal(world, held, target, call.relation, tried)


def other_stands(world: LiveWorld, target: str) -> Iterator[StandPose]:
    """Other standing poses from which the robot reaches other places on the target."""
    here = world.robot
    stands = world.navigator.stands(target, here)
    away = [stand for stand in stands if math.hypot(stand.x_m - here.x_m, stand.y_m - here.y_m) >= APART_M]
    yield from away[:OTHER_STANDS]


def _open(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    other = world.swings.open(target)
    if other:
        return refuse(FailureReason.DOOR_BLOCKED, target=target, other=obstacle_in_words(other))
    world.navigator.refresh()
    world.robot = world.navigator.step_aside(target, world.robot)
    return None


def _close(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    before = world.engine.joints(target)
    panels = DoorPanels(world.engine, world.relations, target)
    shares = (*reversed(SWING), 0.0)
    _, other = panels.swing([min(share, fraction) for fraction in before] for share in shares)
    if not other:
        world.navigator.refresh()
        return None
    panels.restore()
    return refuse(FailureReason.DOOR_BLOCKED, target=target, other=obstacle_in_words(other))


def _toggle_on(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.states[target_of(world, call)].add(State.TOGGLED_ON)
    return None


def _toggle_off(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.states[target_of(world, call)].discard(State.TOGGLED_ON)
    return None


def _wait(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Do nothing: a source acts as soon as its conditions hold."""
    return None


ACTIONS: Final[Mapping[Skill, Action]] = {
    Skill.MOVE: _move,
    Skill.TURN: _turn,
    Skill.PICK_UP: _pick_up,
    Skill.PLACE: _place,
    Skill.MOVE_FORWARD: _move_forward,
    Skill.OPEN: _open,
    Skill.CLOSE: _close,
    Skill.TOGGLE_ON: _toggle_on,
    Skill.TOGGLE_OFF: _toggle_off,
    Skill.HEAT: _wait,
    Skill.COOK: _wait,
    Skill.FREEZE: _wait,
    Skill.GO_TO_ROOM: _go_to_room,
    Skill.SLICE: cut,
    Skill.CLEAN: clean,
    Skill.SOAK: soak,
}
"""Action of each skill."""

HANDLINGS: Final[Mapping[Skill, Handling]] = {
    Skill.PICK_UP: Handling.TAKE,
    Skill.OPEN: Handling.OPEN,
    Skill.CLOSE: Handling.CLOSE,
    Skill.TOGGLE_ON: Handling.PRESS,
    Skill.TOGGLE_OFF: Handling.PRESS,
}
"""Skills that the scene's analysis may report as unreachable for the arm."""
