"""Baselines without a model: lower and upper bounds for measured models.

* ``oracle``: the dataset's own plan, found by a planner that knows the goal and the simulator.
* ``greedy``: a script that knows the goal, but not the simulator. It takes the subgoals in order and writes a few fixed
  calls for each, from the prompt's initial state. It ignores the effects of its own earlier steps.
* ``random``: a few random actions (place an object, open or close, switch), each with the moves that it needs, on objects
  that fit by the prompt. It does not know the goal.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import PromptRow
from embomatrix.skills.syntax import MAX_STEPS, PlaceRelation, Plan, Skill, SkillCall
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.evaluate import instance
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.trainer.data.tasks import TrainingTask

    Baseline = Callable[[TrainingTask, np.random.Generator], Plan]

MAX_ACTIONS: Final = 4
"""Maximum actions of a random plan."""
_DOORS: Final = frozenset({"open", "closed"})
_SWITCHES: Final = frozenset({"on", "off"})
HEATERS: Final = ("microwave", "oven", "stove")
COOLERS: Final = ("fridge", "freezer")
"""Category names of machines that heat and cool, in order of preference."""


class BaselineName(StrEnum):
    """Name of a baseline."""

    ORACLE = "oracle"
    GREEDY = "greedy"
    RANDOM = "random"
    HUMAN = "human"
    """Plans that EAI publishes; not for our own tasks."""


def oracle_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """Return the dataset's plan. Raises TrainerError for a task without one."""
    if not task.oracle:
        raise TrainerError(
            f"the task {task.task.task_id!r} has no oracle plan: build the dataset with `embomatrix factory`, or use another "
            "baseline"
        )
    return task.oracle


def random_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """Return one to ``MAX_ACTIONS`` actions on different objects. Kind and objects are drawn uniformly from those that fit."""
    script = _Script(task)
    loose = [row for row in task.situation.rows if not row.fixed]
    places = [row for row in task.situation.rows if row.fixed]
    doors = [row for row in places if _DOORS & set(row.states)]
    switches = [row for row in task.situation.rows if _SWITCHES & set(row.states)]
    calls: list[SkillCall] = []
    for _ in range(int(rng.integers(1, MAX_ACTIONS + 1))):
        kinds = [kind for kind in (loose if places else [], doors, switches) if kind]
        if not kinds:
            break
        kind = kinds[int(rng.integers(len(kinds)))]
        item = kind.pop(int(rng.integers(len(kind))))
        if kind is loose:
            place = places[int(rng.integers(len(places)))]
            relation = tuple(PlaceRelation)[int(rng.integers(len(PlaceRelation)))]
            calls += script.carry(item, place, relation)
        elif kind is doors:
            calls += _at(item, Skill.CLOSE if "open" in item.states else Skill.OPEN)
        else:
            calls += _at(item, Skill.TOGGLE_OFF if "on" in item.states else Skill.TOGGLE_ON)
    return tuple(calls) or (SkillCall(Skill.MOVE, 0),)


def greedy_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """Return the script's plan. Without any known step, it moves to the first row."""
    script = _Script(task)
    calls = [call for atom, _ in task.task.goal_atoms for call in script.calls_for(atom)]
    return tuple(calls[:MAX_STEPS]) or (SkillCall(Skill.MOVE, 0),)


class _Script:
    def __init__(self, task: TrainingTask) -> None:
        self._types = task.task.types
        self._rows = {row.name: row for row in task.situation.rows}

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
                yield from _at(item, Skill.OPEN)
            case State.TOGGLED_ON, [item] if "off" in item.states:
                yield from _at(item, Skill.TOGGLE_ON)
            case State.HOT | State.COOKED, [item, *stated]:
                yield from self._heat(item, stated or self._rows_of(HEATERS))
            case State.FROZEN, [item, *stated]:
                yield from self._freeze(item, stated or self._rows_of(COOLERS))

    def _negate(self, predicate: str, args: tuple[str, ...]) -> Iterator[SkillCall]:
        row = self._rows.get(args[0])
        if row is None:
            return
        if predicate == State.OPEN and "open" in row.states:
            yield from _at(row, Skill.CLOSE)
        elif predicate == State.TOGGLED_ON and "on" in row.states:
            yield from _at(row, Skill.TOGGLE_OFF)

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
        yield from _at(item, Skill.PICK_UP)

    def _rows_of(self, kinds: Sequence[str]) -> list[PromptRow]:
        return [row for kind in kinds for row in self._rows.values() if kind in row.category]

    def _heat(self, item: PromptRow, machines: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Put the object into the first machine, or onto it if it has no door, close it, and switch it on."""
        for machine in machines[:1]:
            has_door = bool(_DOORS & set(machine.states))
            yield from self.carry(item, machine, PlaceRelation.INSIDE if has_door else PlaceRelation.ONTOP)
            if has_door:
                yield SkillCall(Skill.CLOSE, machine.index)
            if "off" in machine.states:
                yield SkillCall(Skill.TOGGLE_ON, machine.index)

    def _freeze(self, item: PromptRow, machines: Sequence[PromptRow]) -> Iterator[SkillCall]:
        """Put the object into the first machine and close it."""
        for machine in machines[:1]:
            yield from self.carry(item, machine, PlaceRelation.INSIDE)
            if _DOORS & set(machine.states):
                yield SkillCall(Skill.CLOSE, machine.index)


def _at(row: PromptRow, skill: Skill) -> Iterator[SkillCall]:
    yield SkillCall(Skill.MOVE, row.index)
    yield SkillCall(skill, row.index)


def _open(row: PromptRow) -> Iterator[SkillCall]:
    if "closed" in row.states:
        yield from _at(row, Skill.OPEN)


PLANNERS: Final[Mapping[BaselineName, Baseline]] = {
    BaselineName.ORACLE: oracle_plan,
    BaselineName.GREEDY: greedy_plan,
    BaselineName.RANDOM: random_plan,
}
"""Functions that write a task's plan. Equal generators give equal plans. Human plans are not for our own tasks."""
