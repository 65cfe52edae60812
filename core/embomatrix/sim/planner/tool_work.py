"""Subgoals that need a tool, a tap or a washing machine: cutting, cleaning and wetting.

The robot picks a tool up once for all objects that it works on, soaks it once, and puts it down before it carries anything
else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from embomatrix.sim.planner.calls import StuckError
from embomatrix.sim.planner.choices import GroundLiteral
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.state.facts import REAL
from embomatrix.skills.appliances import (
    gives_liquid,
    liquids_given,
    missing_for,
    soaks_up,
    washed_away,
    washing,
)
from embomatrix.skills.syntax import PlaceRelation, Skill
from embomatrix.world.state import State, SubstanceRelation
from embomatrix.world.substances import MEANINGS, RUNNING, word_of

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld


class ToolWork(StrEnum):
    """Kinds of work, in the order in which they are done."""

    SLICE = "slice"
    CLEAN = "clean"
    WET = "wet"


@dataclass(frozen=True, slots=True)
class ToolSubgoal:
    """An object to be sliced, to be freed from a substance, or to be soaked or filled with one."""

    work: ToolWork
    name: str
    substance: str = ""


@dataclass(frozen=True, slots=True)
class ToolMethod:
    """Method for a subgoal: use a ``tool``, which is soaked at ``source`` first if one is named.

    Without a tool the object itself goes to ``source``: it is held under it, or washed in it if ``inside``.
    """

    tool: str = ""
    source: str = ""
    inside: bool = False


def subgoals_for(world: LiveWorld, missing: Iterable[GroundLiteral]) -> tuple[ToolSubgoal, ...]:
    """Return the tool subgoals that make literals true. A literal about a future piece requires the cut."""
    found: dict[ToolSubgoal, None] = {}
    for literal in missing:
        subgoal = subgoal_for(world, literal)
        if subgoal is not None:
            found[subgoal] = None
        elif literal.positive:
            found |= dict.fromkeys(_cuts_for(world, literal.atom.args))
    order = list(ToolWork)
    return tuple(sorted(found, key=lambda subgoal: order.index(subgoal.work)))


def needs_tools(predicate: str) -> bool:
    """True if literals with this predicate come about by tool work only."""
    return predicate in (State.SLICED, REAL, *MEANINGS, *SubstanceRelation)


def subgoal_for(world: LiveWorld, literal: GroundLiteral) -> ToolSubgoal | None:
    """Return the subgoal that makes a literal true, None if there is none."""
    predicate, args = literal.atom.predicate, literal.atom.args
    if predicate in set(MEANINGS):
        fact = MEANINGS[State(predicate)]
        predicate, args = fact.relation.value, (args[0], fact.substance)
    if predicate == State.SLICED:
        return ToolSubgoal(ToolWork.SLICE, args[0]) if literal.positive else None
    if predicate == REAL:
        if literal.positive:
            return next(_cuts_for(world, args), None)
        return ToolSubgoal(ToolWork.SLICE, args[0]) if world.scene.by_name[args[0]].pieces else None
    if predicate == SubstanceRelation.COVERED:
        return None if literal.positive else ToolSubgoal(ToolWork.CLEAN, *args)
    if predicate in set(SubstanceRelation):
        return ToolSubgoal(ToolWork.WET, *args) if literal.positive else None
    return None


def _cuts_for(world: LiveWorld, names: Sequence[str]) -> Iterator[ToolSubgoal]:
    """Yield the cuts that bring absent objects into the world."""
    for name in names:
        if name in world.scene.by_name and not world.is_real(name):
            for item in world.scene.objects:
                if name in item.pieces and world.is_real(item.name):
                    yield ToolSubgoal(ToolWork.SLICE, item.name)


def methods_for(
    world: LiveWorld, rows: Sequence[str], subgoal: ToolSubgoal, portable: frozenset[str]
) -> list[ToolMethod]:
    """Return methods with objects of the table, the simplest first. ``portable``: names that the robot can carry."""
    asset = world.asset(subgoal.name)
    match subgoal.work:
        case ToolWork.SLICE:
            knives = (row for row in rows if row in portable and world.asset(row).can("slicer"))
            return [ToolMethod(tool) for tool in knives] if asset.can("sliceable") else []
        case ToolWork.CLEAN:
            return [*_wipes(world, rows, subgoal, portable), *_washes(world, rows, subgoal, portable)]
        case ToolWork.WET:
            if subgoal.name not in portable or not soaks_up(asset):
                return []
            taps = _giving(world, rows, (subgoal.substance,), subgoal.name)
            sinks = [tap for tap in taps if world.asset(tap).interiors and world.is_fixed(tap)]
            return [
                *(ToolMethod(source=tap) for tap in taps),
                *(ToolMethod(source=tap, inside=True) for tap in sinks),
            ]


def _wipes(
    world: LiveWorld, rows: Sequence[str], subgoal: ToolSubgoal, portable: frozenset[str]
) -> Iterator[ToolMethod]:
    """Yield tools that are ready, then tools that must be switched on or soaked."""
    lacking = {
        tool: missing_for(world.asset(tool), world.facts_about(tool), subgoal.substance, on=world.is_on(tool))
        for tool in rows
        if tool in portable and tool != subgoal.name
    }
    yield from (ToolMethod(tool) for tool, missing in lacking.items() if missing == ())
    for tool, missing in lacking.items():
        if not missing:
            continue
        if RUNNING in missing:
            yield ToolMethod(tool)
        yield from (ToolMethod(tool, source) for source in _giving(world, rows, missing, tool))


def _washes(
    world: LiveWorld, rows: Sequence[str], subgoal: ToolSubgoal, portable: frozenset[str]
) -> Iterator[ToolMethod]:
    if subgoal.name not in portable:
        return
    for row in rows:
        machine = washing(world.asset(row))
        if machine is not None and washed_away(machine, (subgoal.substance,)):
            yield ToolMethod(source=row, inside=True)


def _giving(world: LiveWorld, rows: Sequence[str], liquids: Sequence[str], other: str) -> list[str]:
    """Return rows other than ``other`` that give one of the liquids when they are on."""
    return [
        row
        for row in rows
        if row != other
        and gives_liquid(world.asset(row), world.facts_about(row))
        and set(liquids) & set(liquids_given(world.asset(row), world.facts_about(row), on=True))
    ]


def no_method(subgoal: ToolSubgoal) -> str:
    """Return a sentence that the object table offers no method for a subgoal."""
    match subgoal.work:
        case ToolWork.SLICE:
            return (
                f"nothing in the object table slices {subgoal.name}: expected a knife and a sliceable object"
            )
        case ToolWork.CLEAN:
            return f"nothing in the object table removes {word_of(subgoal.substance)} from {subgoal.name}"
        case ToolWork.WET:
            return (
                f"nothing in the object table soaks or fills {subgoal.name} with {word_of(subgoal.substance)}"
            )


def chosen_methods(
    world: LiveWorld,
    rows: Sequence[str],
    subgoals: Sequence[ToolSubgoal],
    portable: frozenset[str],
    rank: int,
) -> list[tuple[ToolSubgoal, ToolMethod]]:
    """Pair each subgoal with its method of this rank. Raises StuckError for a subgoal without a method."""
    pairs: list[tuple[ToolSubgoal, ToolMethod]] = []
    for subgoal in subgoals:
        found = methods_for(world, rows, subgoal, portable)
        if not found:
            raise StuckError(no_method(subgoal))
        pairs.append((subgoal, found[rank % len(found)]))
    return pairs


def do_tool_work(
    script: PlanScript, world: LiveWorld, pairs: Sequence[tuple[ToolSubgoal, ToolMethod]]
) -> None:
    """Reach all subgoals; those with the same method are done together. Raises StuckError."""
    waiting = list(pairs)
    while waiting:
        subgoal, method = waiting[0]
        if method.inside:
            waiting.pop(0)
            _wash(script, world, method.source, subgoal.name)
            continue
        same = [
            pair for pair in waiting if (pair[1] == method if method.tool else _is_held(pair, subgoal.name))
        ]
        waiting = [pair for pair in waiting if pair not in same]
        if method.tool:
            _with_tool(script, world, method, [each for each, _ in same])
        else:
            _hold_under(script, world, subgoal.name, [each.source for _, each in same])


def _is_held(pair: tuple[ToolSubgoal, ToolMethod], name: str) -> bool:
    """True if the subgoal is reached with the object itself in the hand."""
    subgoal, method = pair
    return subgoal.name == name and not method.tool and not method.inside


def _with_tool(
    script: PlanScript, world: LiveWorld, method: ToolMethod, subgoals: Sequence[ToolSubgoal]
) -> None:
    skill = Skill.SLICE if subgoals[0].work is ToolWork.SLICE else Skill.CLEAN
    for subgoal in subgoals:
        script.open_containers_of(subgoal.name)
        if skill is Skill.SLICE:
            script.unload(subgoal.name)
    if method.source:
        script.open_containers_of(method.source)
        _run_tap(script, world, method.source)
    elif skill is Skill.CLEAN and _must_run(world, method.tool, subgoals):
        script.switch_on(method.tool)
    script.take(method.tool)
    if method.source:
        script.use_on(Skill.SOAK, method.tool, method.source, at=method.source)
    for subgoal in subgoals:
        script.use_on(skill, subgoal.name, method.tool, at=subgoal.name)
    script.put_down(frozenset(subgoal.name for subgoal in subgoals))


def _must_run(world: LiveWorld, tool: str, subgoals: Sequence[ToolSubgoal]) -> bool:
    asset, facts = world.asset(tool), world.facts_about(tool)
    lacking = (missing_for(asset, facts, subgoal.substance, on=world.is_on(tool)) for subgoal in subgoals)
    return any(missing is not None and RUNNING in missing for missing in lacking)


def _wash(script: PlanScript, world: LiveWorld, source: str, name: str) -> None:
    if not world.is_inside(name, source):
        script.transfer(name, source, PlaceRelation.INSIDE)
    machine = washing(world.asset(source))
    if machine is not None and machine.requires_closed:
        script.close(source)
    script.switch_on(source)


def _hold_under(script: PlanScript, world: LiveWorld, name: str, sources: Sequence[str]) -> None:
    """Hold the object under one source after the other."""
    for source in sources:
        script.open_containers_of(source)
        _run_tap(script, world, source)
    script.take(name)
    for source in sources:
        script.use_on(Skill.SOAK, name, source, at=source)
    script.put_down(frozenset())


def _run_tap(script: PlanScript, world: LiveWorld, source: str) -> None:
    """Switch a source on if it gives no liquid while it is off."""
    if not liquids_given(world.asset(source), world.facts_about(source), on=world.is_on(source)):
        script.switch_on(source)
