"""Calls of a script: a demand on objects of a prompt as skill calls, with the effects of its own earlier calls."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.scripts.examples import ScriptExample
from embomatrix.skills.prompt import PromptRow, Situation
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.state import THERMAL, Relation, State

_PHASES: Final[Mapping[str, int]] = {
    State.SLICED: 0,
    **dict.fromkeys(THERMAL, 2),
    **dict.fromkeys(PlaceRelation, 3),
    Relation.NEXTTO: 3,
    Relation.TOUCHING: 3,
    State.OPEN: 4,
    State.TOGGLED_ON: 4,
}
"""Order of the demands of a plan: doors and switches last, since work at a machine changes both."""
_OTHER_PHASE: Final = 1
_PLACEMENTS: Final = frozenset(PlaceRelation)
WETTING: Final = frozenset({"soaked", "saturated", "filled"})
DIRT: Final = frozenset({"dusty", "stained", "covered"})
_TOOL_SKILLS: Final = (Skill.SLICE, Skill.CLEAN, Skill.SOAK)


@dataclass(frozen=True, slots=True)
class ScriptDemand:
    """Demand on one of ``things``, at one of ``places`` if there are any; the first of each is preferred."""

    predicate: str
    holds: bool
    things: tuple[PromptRow, ...]
    places: tuple[PromptRow, ...] = ()


@dataclass(frozen=True)
class Habits:
    """Sources and tools that the oracle's plans of a training split use, by category, the most frequent first.

    ``sources`` maps a thermal state to categories with the relation of the object to the source, ``tools`` a skill to
    categories. ``within_reach`` are containers that the oracle mostly empties from where it opens them.
    """

    sources: Mapping[str, tuple[tuple[str, PlaceRelation], ...]]
    tools: Mapping[Skill, tuple[str, ...]]
    within_reach: frozenset[str]

    @staticmethod
    def of(examples: Sequence[ScriptExample]) -> Habits:
        sources: dict[str, Counter[tuple[str, PlaceRelation]]] = defaultdict(Counter)
        tools: dict[Skill, Counter[str]] = defaultdict(Counter)
        reached: Counter[str] = Counter()
        for example in examples:
            reached.update(_emptied(example))
            by_index = {row.index: row for row in example.situation.rows}
            for call in example.oracle:
                if call.skill in _TOOL_SKILLS and call.source_index in by_index:
                    tools[call.skill][by_index[call.source_index].category] += 1
            for clause in example.intent:
                if clause.predicate in THERMAL:
                    for place, relation in _placed(example, clause.things[0]):
                        sources[clause.predicate][place.category, relation] += 1
        return Habits(
            {state: tuple(key for key, _ in counted.most_common()) for state, counted in sources.items()},
            {skill: tuple(key for key, _ in counted.most_common()) for skill, counted in tools.items()},
            frozenset(category for category, more in reached.items() if more > 0),
        )

    def relation_to(self, source: PromptRow) -> PlaceRelation:
        """Relation to a source: as in training, else inside of what has a door and on top of what has none."""
        known = (
            relation
            for found in self.sources.values()
            for category, relation in found
            if category == source.category
        )
        return next(known, PlaceRelation.INSIDE if _has_door(source) else PlaceRelation.ONTOP)


def _emptied(example: ScriptExample) -> Counter[str]:
    """Count the containers that the oracle empties right after opening them; those that it first moves in count as -1."""
    rows = {row.index: row for row in example.situation.rows}
    hosts = {row.index: example.rows.get(row.host) for row in rows.values()}
    found: Counter[str] = Counter()
    opened: list[PromptRow] = []
    held: int | None = None
    for call in example.oracle:
        index = call.object_index
        if call.skill is Skill.PICK_UP and opened and hosts.get(index or 0) == opened[0]:
            found[opened[0].category] += 1 if len(opened) == 1 else -1
        if call.skill is Skill.PICK_UP:
            held = index
        elif call.skill is Skill.PLACE and held is not None:
            hosts[held] = rows.get(index or 0)
        if call.skill is Skill.OPEN and index in rows:
            opened = [rows[index]]
        elif call.skill is Skill.MOVE and len(opened) == 1 and index in rows:
            opened.append(rows[index])
        else:
            opened = []
    return found


def _placed(example: ScriptExample, thing: str) -> list[tuple[PromptRow, PlaceRelation]]:
    """Return the first place where the oracle puts an object, with the relation; empty if it moves no such object."""
    by_index = {row.index: row for row in example.situation.rows}
    held = ""
    for call in example.oracle:
        row = by_index.get(-1 if call.object_index is None else call.object_index)
        if call.skill is Skill.PICK_UP and row is not None:
            held = row.name
        elif call.skill is Skill.PLACE and held == thing and row is not None and call.relation is not None:
            return [(row, call.relation)]
    return []


def plan_for(demands: Iterable[ScriptDemand], situation: Situation, habits: Habits) -> Plan:
    """Return the calls that meet the demands, as far as the prompt tells."""
    writer = _CallWriter(situation, habits)
    ordered = sorted(demands, key=lambda demand: _PHASES.get(demand.predicate, _OTHER_PHASE))
    return tuple(call for demand in ordered for call in writer.achieve(demand))


class _CallWriter:
    """Writer of calls that keeps track of places, doors and switches."""

    def __init__(self, situation: Situation, habits: Habits) -> None:
        self._habits = habits
        self._rows = {row.name: row for row in situation.rows}
        self._places = {row.name: (row.host, row.relation) for row in situation.rows}
        self._closed = {row.name for row in situation.rows if "closed" in row.states}
        self._on = {row.name for row in situation.rows if "on" in row.states}
        self._here = ""
        self._wet: set[str] = {
            row.name for row in situation.rows if any(state.startswith("soaked") for state in row.states)
        }

    def achieve(self, demand: ScriptDemand) -> Iterator[SkillCall]:
        thing, place = demand.things[0], next(iter(demand.places), None)
        match demand.predicate, demand.holds:
            case predicate, True if predicate in _PLACEMENTS and place is not None:
                yield from self._carry(thing, place, PlaceRelation(predicate))
            case Relation.TOUCHING, True if place is not None:
                yield from self._carry(thing, place, PlaceRelation.ONTOP)
            case State.OPEN, wanted:
                yield from self._open(thing) if wanted else self._close(thing)
            case State.TOGGLED_ON, wanted:
                yield from self._switch(thing, on=wanted)
            case ((State.HOT | State.COOKED | State.FROZEN), True):
                yield from self._treat(thing, State(demand.predicate), demand.places)
            case State.SLICED, True:
                yield from self._work(Skill.SLICE, thing, demand.places)
            case predicate, False if predicate in DIRT:
                yield from self._work(Skill.CLEAN, thing, demand.places)
            case predicate, True if predicate in WETTING:
                yield from self._soak(thing, demand.places)

    def _carry(self, item: PromptRow, place: PromptRow, relation: PlaceRelation) -> Iterator[SkillCall]:
        if self._places[item.name] == (place.name, Relation(relation.value)):
            return
        # A misread sentence may ask for a thing on what it bears itself.
        if item.name == place.name or item.name in self._bearers(place):
            return
        if relation is PlaceRelation.INSIDE:
            yield from self._open(place)
        yield from self._fetch(item)
        yield from self._move(place)
        yield SkillCall(Skill.PLACE, place.index, relation=relation)
        self._places[item.name] = (place.name, Relation(relation.value))

    def _bearers(self, row: PromptRow) -> Iterator[str]:
        """Yield the names of all that the object stands on, in or under, the nearest first."""
        host, _ = self._places[row.name]
        while host in self._rows:
            yield host
            host, _ = self._places[host]

    def _fetch(self, item: PromptRow) -> Iterator[SkillCall]:
        yield from self._uncover(item)
        host, relation = self._places[item.name]
        near = relation is Relation.INSIDE and host == self._here
        if not near or self._rows[host].category not in self._habits.within_reach:
            yield from self._move(item)
        yield SkillCall(Skill.PICK_UP, item.index)
        self._here = ""

    def _move(self, row: PromptRow) -> Iterator[SkillCall]:
        """Go to an object, unless the robot stands there since its last move."""
        if row.name != self._here:
            yield SkillCall(Skill.MOVE, row.index)
            self._here = row.name

    def _use(self, row: PromptRow, skill: Skill) -> Iterator[SkillCall]:
        yield from self._move(row)
        yield SkillCall(skill, row.index)

    def _uncover(self, item: PromptRow) -> Iterator[SkillCall]:
        """Open the closed containers around an object, the outermost first."""
        host, relation = self._places[item.name]
        if host in self._rows and relation is not None:
            yield from self._uncover(self._rows[host])
            if relation is Relation.INSIDE:
                yield from self._open(self._rows[host])

    def _open(self, row: PromptRow) -> Iterator[SkillCall]:
        if row.name in self._closed:
            yield from self._switch(row, on=False)
            yield from self._use(row, Skill.OPEN)
            self._closed.remove(row.name)

    def _close(self, row: PromptRow) -> Iterator[SkillCall]:
        if _has_door(row) and row.name not in self._closed:
            yield from self._use(row, Skill.CLOSE)
            self._closed.add(row.name)

    def _switch(self, row: PromptRow, *, on: bool) -> Iterator[SkillCall]:
        if not {"on", "off"} & {*row.states} or on == (row.name in self._on):
            return
        yield from self._uncover(row)
        yield from self._use(row, Skill.TOGGLE_ON if on else Skill.TOGGLE_OFF)
        self._on ^= {row.name}

    def _treat(self, item: PromptRow, state: State, named: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Bring food to a heat or cold source, close its door and switch it on."""
        usual = [
            row
            for category, _ in self._habits.sources.get(state, ())
            for row in self._rows.values()
            if row.category == category
        ]
        for source in [*named, *usual][:1]:
            relation = self._habits.relation_to(source)
            yield from self._carry(item, source, relation)
            if relation is PlaceRelation.INSIDE:
                yield from self._close(source)
            yield from self._switch(source, on=True) if state is not State.FROZEN else ()

    def _tools(self, skill: Skill, named: Sequence[PromptRow]) -> list[PromptRow]:
        usual = self._habits.tools.get(skill, ())
        return [*named, *(row for kind in usual for row in self._rows.values() if row.category == kind)]

    def _work(self, skill: Skill, item: PromptRow, named: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Use the first tool on an object and put it back. A tool that should take off more than dust is soaked first."""
        for tool in self._tools(skill, named)[:1]:
            back = self._places[tool.name]
            yield from self._uncover(item)
            if skill is Skill.CLEAN and _is_stained(item) and tool.name not in self._wet:
                yield from self._soaked(tool, ())
            else:
                yield from self._fetch(tool)
            yield from self._move(item)
            yield SkillCall(skill, item.index, tool.index)
            yield from self._put_back(tool, back)

    def _soak(self, item: PromptRow, named: Sequence[PromptRow]) -> Iterator[SkillCall]:
        back = self._places[item.name]
        yield from self._soaked(item, named)
        yield from self._put_back(item, back)

    def _soaked(self, item: PromptRow, named: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Fetch an object and hold it under a running source."""
        sources = self._tools(Skill.SOAK, named)[:1]
        for source in sources:
            yield from self._switch(source, on=True)
        yield from self._fetch(item)
        for source in sources:
            yield from self._move(source)
            yield SkillCall(Skill.SOAK, item.index, source.index)
            self._wet.add(item.name)

    def _put_back(self, item: PromptRow, place: tuple[str, Relation | None]) -> Iterator[SkillCall]:
        """Put the held object where it was; on the first fixed row if the prompt doesn't tell.

        A misread sentence may name a fixed object as a tool: it is not put on itself, or on what it bears.
        """
        host, relation = place
        known = host in self._rows and relation is not None
        fixed = (
            row
            for row in self._rows.values()
            if row.fixed and row is not item and item.name not in self._bearers(row)
        )
        back = self._rows[host] if known else next(fixed, None)
        if back is None:
            return
        yield from self._move(back)
        put = PlaceRelation(relation.value) if known and relation is not None else PlaceRelation.ONTOP
        yield SkillCall(Skill.PLACE, back.index, relation=put)
        self._places[item.name] = (back.name, Relation(put.value))


def _is_stained(row: PromptRow) -> bool:
    """Return True if something other than dust covers an object."""
    return any(state == "stained" or state.startswith("covered_with") for state in row.states)


def _has_door(row: PromptRow) -> bool:
    return bool({"open", "closed"} & {*row.states})
