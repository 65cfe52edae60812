"""Feasibility of goal literals: the reasons why neither a skill nor its effects can make a literal true."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.choices import GroundLiteral
from embomatrix.sim.planner.tool_work import methods_for, needs_tools, no_method, subgoal_for
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.state import Relation, State
from embomatrix.world.substances import word_of
from embomatrix.world.task import Profile, Task

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld

SYMMETRIC: Final = frozenset({Relation.NEXTTO, Relation.TOUCHING, Relation.UNDER})
"""Relations that come about by carrying either object."""


def why_impossible(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    """Return a sentence about why no skill makes the literal true, "" if no reason is known.

    The literal must not hold at the moment. A literal without a known reason may still turn out impossible.
    """
    predicate = literal.atom.predicate
    if predicate in set(Relation):
        return _relation_obstacle(world, task, literal)
    if needs_tools(predicate):
        return _tool_obstacle(world, task, literal)
    name = literal.atom.args[0]
    match State(predicate):
        case State.OPEN:
            if not world.asset(name).joints:
                return f"{name} has no door, drawer or lid that opens"
            return _unlisted(task, name)
        case State.TOGGLED_ON:
            return _unlisted(task, name) if world.asset(name).can("toggleable") else f"{name} has no switch"
        case _:
            return _temperature_obstacle(world, task, literal)


def not_portable(world: LiveWorld, name: str) -> str:
    """Return why the robot can't carry the object, "" if it can. Objects in or on it are removed first."""
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


def portables(world: LiveWorld, task: Task) -> frozenset[str]:
    """Return the rows of the table that the robot can carry."""
    return frozenset(name for name in task.table if not not_portable(world, name))


def _unlisted(task: Task, name: str) -> str:
    return "" if name in task.index_of else f"{name} is not in the object table: no plan can name it"


def _relation_obstacle(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    """Check that the first object can be carried, or the second where carrying that one is sufficient."""
    relation, (first, second) = Relation(literal.atom.predicate), literal.atom.args
    if first == second:
        return f"{first} can't be {relation.value} itself"
    movers = [first]
    if relation in SYMMETRIC or (not literal.positive and relation is not Relation.INROOM):
        movers.append(second)
    reasons = [not_portable(world, name) or _unlisted(task, name) for name in movers]
    if all(reasons):
        return reasons[0]
    if literal.positive and relation is Relation.INSIDE and not world.asset(second).interiors:
        return f"nothing can be inside {second}: it has no cavity"
    return ""


def _no_skill(literal: GroundLiteral) -> str:
    name, *substance = literal.atom.args
    change = "made" if literal.positive else "undone"
    state = " ".join((literal.atom.predicate, *map(word_of, substance)))
    return f"none of the skills can do this: {name} must be {change} {state}"


def _tool_obstacle(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    subgoal = subgoal_for(world, literal)
    if subgoal is None or task.profile is Profile.PAPER:
        return _no_skill(literal)
    if methods_for(world, task.table, subgoal, portables(world, task)):
        return _unlisted(task, subgoal.name)
    return no_method(subgoal)


def _temperature_obstacle(world: LiveWorld, task: Task, literal: GroundLiteral) -> str:
    (name, *stated), state = literal.atom.args, State(literal.atom.predicate)
    if state is State.COOKED and not literal.positive:
        return _no_skill(literal)
    able = sources_for(world, task, name, frozenset((state,)), hot=needs_heat(literal))
    if stated and literal.positive:
        return "" if stated[0] in able else f"{stated[0]} does not make {name} {state.value}"
    if able:
        return ""
    change = "" if literal.positive else "no longer "
    return f"no object in the table makes {name} {change}{state.value}: expected a heat or cold source"


def needs_heat(literal: GroundLiteral) -> bool:
    """True if a heat source makes the literal true, False if a cold source does."""
    state = State(literal.atom.predicate)
    return state is State.COOKED or (state is State.HOT) == literal.positive


def sources_for(
    world: LiveWorld, task: Task, name: str, states: frozenset[State], *, hot: bool
) -> tuple[str, ...]:
    """Return the rows of the table that bring states about, or end them, by heat or by cold."""
    item = world.asset(name)
    return tuple(
        other for other in task.table if other != name and _acts_on(world.asset(other), item, states, hot=hot)
    )


def _acts_on(source: Asset, item: Asset, states: frozenset[State], *, hot: bool) -> bool:
    found = heat_source(source) if hot else cold_source(source)
    if found is None:
        return False
    if hot:
        able = heats(found) and item.can("heatable")
        return cooks(found, item) and (able or states == {State.COOKED}) if State.COOKED in states else able
    return freezes(found) and item.can("freezable")
