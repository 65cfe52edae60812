"""Greedy script: takes the subgoals of a goal in order and writes a few fixed calls for each.

It knows the goal, but not the simulator. It reads the prompt's initial state and ignores the effects of its own earlier steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.skills.syntax import MAX_STEPS, PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.evaluate import instance
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from embomatrix.skills.prompt import PromptRow, Situation
    from embomatrix.world.task import Task

DOORS: Final = frozenset({"open", "closed"})
"""States of a door in a prompt."""
HEATERS: Final = ("microwave", "oven", "stove")
COOLERS: Final = ("fridge", "freezer")
"""Category names of machines that heat and cool, in order of preference."""


def greedy_plan(task: Task, situation: Situation) -> Plan:
    """Return the script's plan. Without any known step, it moves to the first row."""
    script = SubgoalCalls(task, situation)
    calls = [call for atom, _ in task.goal_atoms for call in script.calls_for(atom)]
    return tuple(calls[:MAX_STEPS]) or (SkillCall(Skill.MOVE, 0),)


class SubgoalCalls:
    """Fixed calls for subgoals of a task, from the initial state of its prompt."""

    def __init__(self, task: Task, situation: Situation) -> None:
        self._types = task.types
        self._rows = {row.name: row for row in situation.rows}

    def calls_for(self, atom: Formula) -> Iterator[SkillCall]:
        """Calls that achieve a scored subgoal. Of alternatives, the first is taken."""
        for literal in self._literals(atom):
            match literal:
                case Atom(predicate, args):
                    yield from self._achieve(predicate, args)
                case Not(Atom(predicate, args)):
                    yield from self._negate(predicate, args)

    def _literals(self, formula: Formula) -> Iterator[Formula]:
        match formula:
            case And(parts):
                for part in parts:
                    yield from self._literals(part)
            case Or(parts):
                yield from self._literals(parts[0])
            case Imply(_, conclusion):
                yield from self._literals(conclusion)
            case Quantified(quantifier, binders, _, count):
                rows = zip(*(self._types[kind] for _, kind in binders), strict=False)
                limit = {Quantifier.EXISTS: 1, Quantifier.FORN: count}.get(quantifier)
                for names in itertools.islice(rows, limit):
                    yield from self._literals(instance(formula, *names))
            case _:
                yield formula

    def _achieve(self, predicate: str, args: tuple[str, ...]) -> Iterator[SkillCall]:
        rows = [self._rows[name] for name in args if name in self._rows]
        if len(rows) != len(args):
            return
        match predicate, rows:
            case Relation.INSIDE | Relation.ONTOP | Relation.UNDER | Relation.NEXTTO, [item, place]:
                yield from self.carry(item, place, PlaceRelation(predicate))
            case Relation.TOUCHING, [item, place]:
                yield from self.carry(item, place, PlaceRelation.ONTOP)
            case State.OPEN, [item] if "closed" in item.states:
                yield from calls_at(item, Skill.OPEN)
            case State.TOGGLED_ON, [item] if "off" in item.states:
                yield from calls_at(item, Skill.TOGGLE_ON)
            case State.HOT | State.COOKED, [item, *stated]:
                yield from self._heat(item, stated or self._rows_of(HEATERS))
            case State.FROZEN, [item, *stated]:
                yield from self._freeze(item, stated or self._rows_of(COOLERS))

    def _negate(self, predicate: str, args: tuple[str, ...]) -> Iterator[SkillCall]:
        row = self._rows.get(args[0])
        if row is None:
            return
        if predicate == State.OPEN and "open" in row.states:
            yield from calls_at(row, Skill.CLOSE)
        elif predicate == State.TOGGLED_ON and "on" in row.states:
            yield from calls_at(row, Skill.TOGGLE_OFF)

    def carry(self, item: PromptRow, place: PromptRow, relation: PlaceRelation) -> Iterator[SkillCall]:
        """Calls that put an object somewhere; none if it is already there."""
        if item.host == place.name and item.relation is not None and item.relation.value == relation:
            return
        if relation is PlaceRelation.INSIDE:
            yield from _open(place)
        yield from self._fetch(item)
        yield SkillCall(Skill.MOVE, place.index)
        yield SkillCall(Skill.PLACE, place.index, relation=relation)

    def _fetch(self, item: PromptRow) -> Iterator[SkillCall]:
        host = self._rows.get(item.host)
        if host is not None and item.relation is Relation.INSIDE:
            yield from _open(host)
        yield from calls_at(item, Skill.PICK_UP)

    def _rows_of(self, kinds: Sequence[str]) -> list[PromptRow]:
        return [row for kind in kinds for row in self._rows.values() if kind in row.category]

    def _heat(self, item: PromptRow, machines: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Put the object into the first machine, or onto it if it has no door, close it, and switch it on."""
        for machine in machines[:1]:
            has_door = bool(DOORS & set(machine.states))
            yield from self.carry(item, machine, PlaceRelation.INSIDE if has_door else PlaceRelation.ONTOP)
            if has_door:
                yield SkillCall(Skill.CLOSE, machine.index)
            if "off" in machine.states:
                yield SkillCall(Skill.TOGGLE_ON, machine.index)

    def _freeze(self, item: PromptRow, machines: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Put the object into the first machine and close it."""
        for machine in machines[:1]:
            yield from self.carry(item, machine, PlaceRelation.INSIDE)
            if DOORS & set(machine.states):
                yield SkillCall(Skill.CLOSE, machine.index)


def calls_at(row: PromptRow, skill: Skill) -> Iterator[SkillCall]:
    """Go to an object and use a skill on it."""
    yield SkillCall(Skill.MOVE, row.index)
    yield SkillCall(skill, row.index)


def _open(row: PromptRow) -> Iterator[SkillCall]:
    if "closed" in row.states:
        yield from calls_at(row, Skill.OPEN)
