"""What each skill does in cached mode once its preconditions hold: pick an outcome and instantiate it, without stepping."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

from embomatrix.sim.blockers import no_way_for_arm, no_way_into, no_way_to, no_way_to_place
from embomatrix.sim.household import clean, cut, soak
from embomatrix.sim.joints.panels import Leaves
from embomatrix.sim.joints.swings import SWING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill
from embomatrix.skills.view import metres, preposition, refuse, target_of
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import Handling, StandPose
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    import numpy as np

    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.view import SkillRefusal

    Action = Callable[[LiveWorld, SkillCall, np.random.Generator], SkillRefusal | None]

OTHER_STANDS: Final = 2
APART_M: Final = 0.4
"""A crowded support is served from up to two other standing poses, this far or further from the first."""


class CachedActor:
    """The language-physics interface: outcomes found before are instantiated. Holds nothing of its own."""

    drawing = frozenset({Skill.PLACE, Skill.SLICE})

    def reset(self, world: LiveWorld) -> None:
        """Nothing to do: all there is, is in the world."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        """Carry out a call whose preconditions hold. A refusal leaves the world as it was."""
        handling = HANDLINGS.get(call.skill)
        refusal = no_way_for_arm(world, handling, target_of(world, call)) if handling is not None else None
        return refusal or ACTIONS[call.skill](world, call, rng)

    def close(self) -> None:
        """Nothing to free."""


def _move(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    stand = world.navigator.nearest_stand(target, world.robot)
    if stand is None:
        return no_way_to(world, target)
    world.robot = stand
    return None


def _turn(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.robot = StandPose(world.robot.x_m, world.robot.y_m, _heading(world, call))
    return None


def _move_forward(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    heading, distance_m = _heading(world, call), call.distance or 0.0
    course = heading if distance_m >= 0 else heading + math.pi
    free_m = world.navigator.forward(world.robot, course, abs(distance_m))
    if free_m < abs(distance_m):
        return refuse(FailureReason.BLOCKED, distance=metres(free_m))
    x = world.robot.x_m + math.cos(course) * abs(distance_m)
    y = world.robot.y_m + math.sin(course) * abs(distance_m)
    world.robot = StandPose(x, y, heading)
    return None


def _heading(world: LiveWorld, call: SkillCall) -> float:
    """The present heading and the call's angle, in [-pi, pi]."""
    return math.remainder(world.robot.yaw + math.remainder(call.yaw or 0.0, math.tau), math.tau)


def _go_to_room(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    room = call.room_name or ""
    entry = world.navigator.room_entry(room, world.robot)
    if entry is None:
        return no_way_into(world, room)
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
    refusal = no_way_to_place(world, held, target, relation)
    if refusal is not None:
        return refusal
    fails = FailureReason.NO_FREE_POSE
    tried: tuple[StandPose, ...] = ()
    for stand in itertools.chain((world.robot,), other_stands(world, target)):
        found = world.placer.find(held, target, relation, stand, rng, tried)
        if isinstance(found, Pose) and world.hand.let_go(found):
            world.robot = stand
            world.navigator.refresh()
            return None
        if isinstance(found, FailureReason) and found is not FailureReason.NO_FREE_POSE:
            fails = found
            break
        tried = (*tried, stand)
    return refuse(fails, held=held, target=target, relation=preposition(call.relation))


def other_stands(world: LiveWorld, target: str) -> Iterator[StandPose]:
    """Where else the robot may stand to place something, apart from where it stands: from there it reaches other spots."""
    here = world.robot
    stands = world.navigator.stands(target, here)
    away = [stand for stand in stands if math.hypot(stand.x_m - here.x_m, stand.y_m - here.y_m) >= APART_M]
    yield from away[:OTHER_STANDS]


def _open(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    other = world.swings.open(target)
    if other:
        return refuse(FailureReason.DOOR_BLOCKED, target=target, other=other)
    world.navigator.refresh()
    world.robot = world.navigator.aside(target, world.robot)
    return None


def _close(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    target = target_of(world, call)
    before = world.engine.joints(target)
    leaves = Leaves(world.engine, world.relations, target)
    shares = (*reversed(SWING), 0.0)
    _, other = leaves.swing([min(share, fraction) for fraction in before] for share in shares)
    if not other:
        world.navigator.refresh()
        return None
    leaves.put_back()
    return refuse(FailureReason.DOOR_BLOCKED, target=target, other=other)


def _toggle_on(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.states[target_of(world, call)].add(State.TOGGLED_ON)
    return None


def _toggle_off(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world.states[target_of(world, call)].discard(State.TOGGLED_ON)
    return None


def _wait(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """The source acts by itself as soon as its conditions hold: waiting changes nothing more."""
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
"""One action for each skill."""

HANDLINGS: Final[Mapping[Skill, Handling]] = {
    Skill.PICK_UP: Handling.TAKE,
    Skill.OPEN: Handling.OPEN,
    Skill.CLOSE: Handling.CLOSE,
    Skill.TOGGLE_ON: Handling.PRESS,
    Skill.TOGGLE_OFF: Handling.PRESS,
}
"""Skills of which the scene's analysis knows where the arm finds no way."""
