"""How an oracle cuts, cleans and wets: which tools, sinks and machines serve, and the calls that it takes with them.

A tool is taken up once for all that is done with it, soaked once, and laid down before anything else is carried.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from embomatrix.sim.planner.calls import StuckError
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
    from collections.abc import Iterable, Iterator, Sequence

    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.planner.choices import GroundLiteral
    from embomatrix.sim.planner.script import PlanScript

REAL = "real"


class ChoreKind(StrEnum):
    """Kinds of chores, in the order in which they are done."""

    SLICE = "slice"
    CLEAN = "clean"
    WET = "wet"


@dataclass(frozen=True, slots=True)
class Chore:
    """An object must be sliced, or rid of a substance, or soaked or filled with one."""

    work: ChoreKind
    name: str
    substance: str = ""


@dataclass(frozen=True, slots=True)
class ChoreMethod:
    """How a chore is done: with a ``tool`` in the hand, soaked at ``source`` first if that is named.

    Without a tool the object itself is taken to ``source``: held under it, or washed in it if ``inside``.
    """

    tool: str = ""
    source: str = ""
    inside: bool = False


def chores_for(world: LiveWorld, missing: Iterable[GroundLiteral]) -> tuple[Chore, ...]:
    """What must be cut, cleaned and wetted so that the literals hold. Literals about pieces ask for the cut."""
    found: dict[Chore, None] = {}
    for literal in missing:
        chore = chore_for(world, literal)
        if chore is not None:
            found[chore] = None
        elif literal.positive:
            found |= dict.fromkeys(_cuts_for(world, literal.atom.args))
    order = list(ChoreKind)
    return tuple(sorted(found, key=lambda chore: order.index(chore.work)))


def is_about_chores(predicate: str) -> bool:
    """Whether literals with this predicate come about by chores, if at all."""
    return predicate in (State.SLICED, REAL, *MEANINGS, *SubstanceRelation)


def chore_for(world: LiveWorld, literal: GroundLiteral) -> Chore | None:
    """The chore that makes a literal true; None when none does."""
    predicate, args = literal.atom.predicate, literal.atom.args
    if predicate in set(MEANINGS):
        fact = MEANINGS[State(predicate)]
        predicate, args = fact.relation.value, (args[0], fact.substance)
    if predicate == State.SLICED:
        return Chore(ChoreKind.SLICE, args[0]) if literal.positive else None
    if predicate == REAL:
        if literal.positive:
            return next(_cuts_for(world, args), None)
        return Chore(ChoreKind.SLICE, args[0]) if world.scene.by_name[args[0]].pieces else None
    if predicate == SubstanceRelation.COVERED:
        return None if literal.positive else Chore(ChoreKind.CLEAN, *args)
    if predicate in set(SubstanceRelation):
        return Chore(ChoreKind.WET, *args) if literal.positive else None
    return None


def _cuts_for(world: LiveWorld, names: Sequence[str]) -> Iterator[Chore]:
    """Chores that bring the absent ones among the names into the world."""
    for name in names:
        if name in world.scene.by_name and not world.is_real(name):
            for item in world.scene.objects:
                if name in item.pieces and world.is_real(item.name):
                    yield Chore(ChoreKind.SLICE, item.name)


def means_for(
    world: LiveWorld, rows: Sequence[str], chore: Chore, portable: frozenset[str]
) -> list[ChoreMethod]:
    """Ways to do a chore with what stands in the object table, the simplest first. ``portable`` can be carried."""
    match chore.work:
        case ChoreKind.SLICE:
            if not world.asset(chore.name).can("sliceable"):
                return []
            return [
                ChoreMethod(tool) for tool in rows if tool in portable and world.asset(tool).can("slicer")
            ]
        case ChoreKind.CLEAN:
            return [*_wipes(world, rows, chore, portable), *_washes(world, rows, chore, portable)]
        case ChoreKind.WET:
            if chore.name not in portable or not soaks_up(world.asset(chore.name)):
                return []
            taps = _giving(world, rows, (chore.substance,), chore.name)
            sinks = [tap for tap in taps if world.asset(tap).interiors and world.is_fixed(tap)]
            return [
                *(ChoreMethod(source=tap) for tap in taps),
                *(ChoreMethod(source=tap, inside=True) for tap in sinks),
            ]


def _wipes(
    world: LiveWorld, rows: Sequence[str], chore: Chore, portable: frozenset[str]
) -> Iterator[ChoreMethod]:
    """With a tool that is ready, then with one that must be switched on or soaked."""
    lacking = {
        tool: missing_for(world.asset(tool), world.facts_about(tool), chore.substance, on=world.is_on(tool))
        for tool in rows
        if tool in portable and tool != chore.name
    }
    yield from (ChoreMethod(tool) for tool, missing in lacking.items() if missing == ())
    for tool, missing in lacking.items():
        if not missing:
            continue
        if RUNNING in missing:
            yield ChoreMethod(tool)
        yield from (ChoreMethod(tool, source) for source in _giving(world, rows, missing, tool))


def _washes(
    world: LiveWorld, rows: Sequence[str], chore: Chore, portable: frozenset[str]
) -> Iterator[ChoreMethod]:
    if chore.name not in portable:
        return
    for row in rows:
        machine = washing(world.asset(row))
        if machine is not None and washed_away(machine, (chore.substance,)):
            yield ChoreMethod(source=row, inside=True)


def _giving(world: LiveWorld, rows: Sequence[str], liquids: Sequence[str], other: str) -> list[str]:
    """Rows that give one of the liquids, once they are on."""
    return [
        row
        for row in rows
        if row != other
        and gives_liquid(world.asset(row), world.facts_about(row))
        and set(liquids) & set(liquids_given(world.asset(row), world.facts_about(row), on=True))
    ]


def nothing_for(chore: Chore) -> str:
    """Sentence about a chore for which the object table has no means."""
    match chore.work:
        case ChoreKind.SLICE:
            return f"nothing in the object table slices {chore.name}: expected a knife, and a thing that can be cut"
        case ChoreKind.CLEAN:
            return f"nothing in the object table takes {word_of(chore.substance)} off {chore.name}"
        case ChoreKind.WET:
            return f"nothing in the object table soaks or fills {chore.name} with {word_of(chore.substance)}"


def do_chores(script: PlanScript, world: LiveWorld, chores: Sequence[tuple[Chore, ChoreMethod]]) -> None:
    """Do them, all that one means serves together. Raises StuckError."""
    waiting = list(chores)
    while waiting:
        means = waiting[0][1]
        if means.inside:
            _wash(script, world, means.source, waiting.pop(0)[0].name)
            continue
        name = waiting[0][0].name
        same = [pair for pair in waiting if (pair[1] == means if means.tool else _is_held(pair, name))]
        waiting = [pair for pair in waiting if pair not in same]
        if means.tool:
            _with_tool(script, world, means, [chore for chore, _ in same])
        else:
            _hold_under(script, world, name, [other.source for _, other in same])


def _with_tool(script: PlanScript, world: LiveWorld, means: ChoreMethod, chores: Sequence[Chore]) -> None:
    skill = Skill.SLICE if chores[0].work is ChoreKind.SLICE else Skill.CLEAN
    for chore in chores:
        script.clear_way_to(chore.name)
        if skill is Skill.SLICE:
            script.unload(chore.name)
    if means.source:
        script.clear_way_to(means.source)
        _run_tap(script, world, means.source)
    elif skill is Skill.CLEAN and _must_run(world, means.tool, chores):
        script.switch_on(means.tool)
    script.take(means.tool)
    if means.source:
        script.use_on(Skill.SOAK, means.tool, means.source, at=means.source)
    for chore in chores:
        script.use_on(skill, chore.name, means.tool, at=chore.name)
    script.lay_down(frozenset(chore.name for chore in chores))


def _must_run(world: LiveWorld, tool: str, chores: Sequence[Chore]) -> bool:
    asset, facts = world.asset(tool), world.facts_about(tool)
    lacking = (missing_for(asset, facts, chore.substance, on=world.is_on(tool)) for chore in chores)
    return any(missing is not None and RUNNING in missing for missing in lacking)


def _is_held(pair: tuple[Chore, ChoreMethod], name: str) -> bool:
    """Whether the chore is done with the object itself in the hand."""
    chore, means = pair
    return chore.name == name and not means.tool and not means.inside


def _wash(script: PlanScript, world: LiveWorld, source: str, name: str) -> None:
    if not world.is_inside(name, source):
        script.transfer(name, source, PlaceRelation.INSIDE)
    machine = washing(world.asset(source))
    if machine is not None and machine.requires_closed:
        script.close(source)
    script.switch_on(source)


def _hold_under(script: PlanScript, world: LiveWorld, name: str, sources: Sequence[str]) -> None:
    """Take the object to one source after the other."""
    for source in sources:
        script.clear_way_to(source)
        _run_tap(script, world, source)
    script.take(name)
    for source in sources:
        script.use_on(Skill.SOAK, name, source, at=source)
    script.lay_down(frozenset())


def _run_tap(script: PlanScript, world: LiveWorld, source: str) -> None:
    """Switch a source on that gives nothing while it is off."""
    if not liquids_given(world.asset(source), world.facts_about(source), on=world.is_on(source)):
        script.switch_on(source)


def chosen(
    world: LiveWorld, rows: Sequence[str], chores: Sequence[Chore], portable: frozenset[str], rank: int
) -> list[tuple[Chore, ChoreMethod]]:
    """Each chore with its means of this rank. Raises StuckError for a chore without any."""
    pairs: list[tuple[Chore, ChoreMethod]] = []
    for chore in chores:
        found = means_for(world, rows, chore, portable)
        if not found:
            raise StuckError(nothing_for(chore))
        pairs.append((chore, found[rank % len(found)]))
    return pairs
