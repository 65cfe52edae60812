"""What no plan can bring about, told before one is tried: literals that neither a skill nor its effects can make true."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.chores import chore_for, is_about_chores, means_for, nothing_for
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.skills.limits import ROBOT
from embomatrix.world.state import Relation, State
from embomatrix.world.substances import word_of
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.planner.choices import GroundLiteral
    from embomatrix.world.asset import Asset
    from embomatrix.world.task import Task

    Limit = Callable[[LiveWorld, Task, GroundLiteral], str]

EITHER: Final = frozenset({Relation.NEXTTO, Relation.TOUCHING, Relation.UNDER})
"""Relations that come about by carrying either object."""


def why_impossible(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    """A sentence about why no skill makes the literal true, "" when nothing speaks against it.

    The literal must not hold at the moment. What is let pass may still turn out impossible.
    """
    predicate = literal.atom.predicate
    if predicate in set(Relation):
        return _relation_limit(world, task, literal)
    if is_about_chores(predicate):
        return _chore_limit(world, task, literal)
    return STATE_LIMITS[State(predicate)](world, task, literal)


def carries(world: LiveWorld, name: str) -> str:
    """Why the robot can't carry the object, "" when it can: what lies in or on it is taken off first."""
    asset = world.asset(name)
    if world.is_fixed(name):
        return f"{name} is fixed and can't be picked up"
    if asset.mass_kg > ROBOT.mass_kg:
        return f"{name} weighs {asset.mass_kg:.1f} kg and the arm lifts {ROBOT.mass_kg:.1f} kg"
    if max(asset.size_m) > ROBOT.extent_m or min(asset.size_m) > ROBOT.grip_m:
        sizes = " x ".join(f"{size:.2f}" for size in asset.size_m)
        return (
            f"{name} measures {sizes} m: the gripper takes {ROBOT.grip_m} m, and {ROBOT.extent_m} m at most"
        )
    return ""


def _relation_limit(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    """Something of a relation must be carried: the first object, or either of both where that does too."""
    relation, (first, second) = Relation(literal.atom.predicate), literal.atom.args
    if first == second:
        return f"{first} can't be {relation.value} itself"
    movers = [first]
    if relation in EITHER or (not literal.positive and relation is not Relation.INROOM):
        movers.append(second)
    reasons = [_unmoved(world, task, name) for name in movers]
    if all(reasons):
        return reasons[0]
    if literal.positive and relation is Relation.INSIDE and not world.asset(second).interiors:
        return f"nothing can be inside {second}: it has no cavity"
    return ""


def _unmoved(world: LiveWorld, task: Task, name: str) -> str:
    return carries(world, name) or _unlisted(task, name)


def _unlisted(task: Task, name: str) -> str:
    return "" if name in task.index_of else f"{name} is not in the object table: no plan can name it"


def _open_limit(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    (name,) = literal.atom.args
    if not world.asset(name).joints:
        return f"{name} has no door, drawer or lid that opens"
    return _unlisted(task, name)


def _switch_limit(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    (name,) = literal.atom.args
    if not world.asset(name).can("toggleable"):
        return f"{name} has no switch"
    return _unlisted(task, name)


def _no_skill(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    name, *substance = literal.atom.args
    change = "made" if literal.positive else "undone"
    what = " ".join((literal.atom.predicate, *map(word_of, substance)))
    return f"none of the skills can do this: {name} must be {change} {what}"


def _chore_limit(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    """Chores need their own skills, and something in the table to do them with."""
    chore = chore_for(world, literal)
    if chore is None or task.profile is Profile.PAPER:
        return _no_skill(world, task, literal)
    if means_for(world, task.table, chore, portables(world, task)):
        return _unlisted(task, chore.name)
    return nothing_for(chore)


def portables(world: LiveWorld, task: Task) -> frozenset[str]:
    """Rows of the table that the robot can carry."""
    return frozenset(name for name in task.table if not carries(world, name))


def _temperature_limit(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    (name,), state = literal.atom.args, State(literal.atom.predicate)
    if state is State.COOKED and not literal.positive:
        return _no_skill(world, task, literal)
    if sources_for(world, task, name, frozenset((state,)), hot=is_hot_work(literal)):
        return ""
    change = "" if literal.positive else "no longer "
    return f"no object in the table makes {name} {change}{state.value}: expected a heat or cold source"


def is_hot_work(literal: GroundLiteral) -> bool:
    """Whether a heat source brings the literal about, not a cold one."""
    state = State(literal.atom.predicate)
    return state is State.COOKED or (state is State.HOT) == literal.positive


def sources_for(
    world: LiveWorld, task: Task, name: str, states: frozenset[State], *, hot: bool
) -> tuple[str, ...]:
    """Rows of the table that bring the states about, or end them, by heat or by cold."""
    item = world.asset(name)
    return tuple(
        other for other in task.table if other != name and _does(world.asset(other), item, states, hot=hot)
    )


def _does(source: Asset, item: Asset, states: frozenset[State], *, hot: bool) -> bool:
    found = heat_source(source) if hot else cold_source(source)
    if found is None:
        return False
    if hot:
        able = heats(found) and item.can("heatable")
        return cooks(found, item) and (able or states == {State.COOKED}) if State.COOKED in states else able
    return freezes(found) and item.can("freezable")


STATE_LIMITS: Final[Mapping[State, Limit]] = {
    State.OPEN: _open_limit,
    State.TOGGLED_ON: _switch_limit,
    State.HOT: _temperature_limit,
    State.COOKED: _temperature_limit,
    State.FROZEN: _temperature_limit,
    State.SLICED: _chore_limit,
    State.DUSTY: _chore_limit,
    State.STAINED: _chore_limit,
    State.SOAKED: _chore_limit,
}
"""What speaks against a change of each state."""
