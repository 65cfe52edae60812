"""Baselines that need no model: what a measured model has to beat, and what it can reach.

* ``oracle``: the plan that the dataset carries, found by a planner that knows the goal and the simulator.
* ``greedy``: a script that knows the goal, not the simulator. It takes the sub-goals in their order and writes the same few
  calls for each, from what a prompt tells of the start; it does not look at what its own earlier steps changed.
* ``random``: a few deeds (put something somewhere, open or close, switch), each with the moves that it takes, on objects that
  it fits by what a prompt tells. It knows nothing of the goal.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.skills.syntax import MAX_STEPS, PlaceRelation, Skill, SkillCall
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.evaluate import substitute
from embomatrix.world.goal import And, Atom, Exists, Forall, ForN, ForNPairs, ForPairs, Imply, Not, Or
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import numpy as np

    from embomatrix.skills.prompt import PromptRow
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.world.goal import Formula

    Baseline = Callable[[TrainingTask, np.random.Generator], Plan]

MAX_DEEDS: Final = 4
"""Of a random plan."""
_DOORS: Final = frozenset({"open", "closed"})
_SWITCHES: Final = frozenset({"on", "off"})
HEATERS: Final = ("microwave", "oven", "stove")
COOLERS: Final = ("fridge", "freezer")
"""What the script looks for in a category's name, best first, to warm and to cool things."""


class BaselineName(StrEnum):
    """Who writes plans without a model."""

    ORACLE = "oracle"
    GREEDY = "greedy"
    RANDOM = "random"
    HUMAN = "human"
    """Not ours to write: the plans that EAI publishes."""


def baseline_for(name: BaselineName) -> Baseline:
    """The function that writes a task's plan; equal generators give equal plans. Not for ``HUMAN``."""
    return PLANNERS[name]


def oracle_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """The dataset's own plan. Raises TrainerError for a task without one."""
    if not task.oracle:
        raise TrainerError(
            f"the task {task.task.task_id!r} carries no oracle plan: build the dataset with `embomatrix factory`, or measure "
            "another baseline"
        )
    return task.oracle


def random_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """One to ``MAX_DEEDS`` deeds, each about another thing: kind of deed, then objects, drawn uniformly from what fits."""
    script = _Script(task)
    loose = [row for row in task.situation.rows if not row.fixed]
    places = [row for row in task.situation.rows if row.fixed]
    doors = [row for row in places if _DOORS & set(row.states)]
    switches = [row for row in task.situation.rows if _SWITCHES & set(row.states)]
    calls: list[SkillCall] = []
    for _ in range(int(rng.integers(1, MAX_DEEDS + 1))):
        kinds = [kind for kind in (loose if places else [], doors, switches) if kind]
        if not kinds:
            break
        kind = kinds[int(rng.integers(len(kinds)))]
        thing = kind.pop(int(rng.integers(len(kind))))
        if kind is loose:
            place = places[int(rng.integers(len(places)))]
            relation = tuple(PlaceRelation)[int(rng.integers(len(PlaceRelation)))]
            calls += script.carry(thing, place, relation)
        elif kind is doors:
            calls += _at(thing, Skill.CLOSE if "open" in thing.states else Skill.OPEN)
        else:
            calls += _at(thing, Skill.TOGGLE_OFF if "on" in thing.states else Skill.TOGGLE_ON)
    return tuple(calls) or (SkillCall(Skill.MOVE, 0),)


def greedy_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """The script's plan; it draws nothing. Where it knows no step at all, it moves to the first row."""
    script = _Script(task)
    calls = [call for atom, _ in task.task.goal_atoms for call in script.towards(atom)]
    return tuple(calls[:MAX_STEPS]) or (SkillCall(Skill.MOVE, 0),)


class _Script:
    def __init__(self, task: TrainingTask) -> None:
        self._types = task.task.types
        self._rows = {row.name: row for row in task.situation.rows}

    def towards(self, atom: Formula) -> Iterator[SkillCall]:
        """Calls for a scored sub-goal: of choices the first one."""
        for literal in self._literals(atom):
            match literal:
                case Atom(predicate, args):
                    yield from self._make(predicate, args)
                case Not(Atom(predicate, args)):
                    yield from self._undo(predicate, args)

    def _literals(self, formula: Formula) -> Iterator[Formula]:
        match formula:
            case And(parts):
                for part in parts:
                    yield from self._literals(part)
            case Or(parts):
                yield from self._literals(parts[0])
            case Imply(_, conclusion):
                yield from self._literals(conclusion)
            case Forall(variable, kind, body):
                yield from self._ground(body, variable, self._types[kind])
            case Exists(variable, kind, body):
                yield from self._ground(body, variable, self._types[kind][:1])
            case ForN(count, variable, kind, body):
                yield from self._ground(body, variable, self._types[kind][:count])
            case ForPairs(a, kind_a, b, kind_b, body) | ForNPairs(_, a, kind_a, b, kind_b, body):
                for one, other in zip(self._types[kind_a], self._types[kind_b], strict=False):
                    yield from self._literals(substitute(body, {a: one, b: other}))
            case _:
                yield formula

    def _ground(self, body: Formula, variable: str, names: Sequence[str]) -> Iterator[Formula]:
        for name in names:
            yield from self._literals(substitute(body, {variable: name}))

    def _make(self, predicate: str, args: tuple[str, ...]) -> Iterator[SkillCall]:
        rows = [self._rows[name] for name in args if name in self._rows]
        if len(rows) != len(args):
            return
        match predicate, rows:
            case Relation.INSIDE | Relation.ONTOP | Relation.UNDER, [thing, place]:
                yield from self.carry(thing, place, PlaceRelation(predicate))
            case Relation.TOUCHING, [thing, place]:
                yield from self.carry(thing, place, PlaceRelation.ONTOP)
            case Relation.NEXTTO, [thing, other] if other.host in self._rows and other.relation is not None:
                place = self._rows[other.host]
                yield from self.carry(thing, place, PlaceRelation(other.relation.value))
            case State.OPEN, [thing] if "closed" in thing.states:
                yield from _at(thing, Skill.OPEN)
            case State.TOGGLED_ON, [thing] if "off" in thing.states:
                yield from _at(thing, Skill.TOGGLE_ON)
            case State.HOT | State.COOKED, [thing]:
                yield from self._process(thing, HEATERS, switch=True)
            case State.FROZEN, [thing]:
                yield from self._process(thing, COOLERS, switch=False)

    def _undo(self, predicate: str, args: tuple[str, ...]) -> Iterator[SkillCall]:
        row = self._rows.get(args[0])
        if row is None:
            return
        if predicate == State.OPEN and "open" in row.states:
            yield from _at(row, Skill.CLOSE)
        elif predicate == State.TOGGLED_ON and "on" in row.states:
            yield from _at(row, Skill.TOGGLE_OFF)

    def carry(self, thing: PromptRow, place: PromptRow, relation: PlaceRelation) -> Iterator[SkillCall]:
        """Calls that put a thing somewhere, none where it is there already."""
        if thing.host == place.name and thing.relation is not None and thing.relation.value == relation:
            return
        if relation is PlaceRelation.INSIDE:
            yield from _opened(place)
        yield from self._fetch(thing)
        yield SkillCall(Skill.MOVE, place.index)
        yield SkillCall(Skill.PLACE, place.index, relation=relation)

    def _fetch(self, thing: PromptRow) -> Iterator[SkillCall]:
        host = self._rows.get(thing.host)
        if host is not None and thing.relation is Relation.INSIDE:
            yield from _opened(host)
        yield from _at(thing, Skill.PICK_UP)

    def _process(self, thing: PromptRow, kinds: Sequence[str], *, switch: bool) -> Iterator[SkillCall]:
        """Into the first machine of these kinds, shut, and switched on where it has to be."""
        found = [row for kind in kinds for row in self._rows.values() if kind in row.category]
        if not found:
            return
        machine = found[0]
        yield from self.carry(thing, machine, PlaceRelation.INSIDE)
        if _DOORS & set(machine.states):
            yield SkillCall(Skill.CLOSE, machine.index)
        if switch and "off" in machine.states:
            yield SkillCall(Skill.TOGGLE_ON, machine.index)


def _at(row: PromptRow, skill: Skill) -> Iterator[SkillCall]:
    yield SkillCall(Skill.MOVE, row.index)
    yield SkillCall(skill, row.index)


def _opened(row: PromptRow) -> Iterator[SkillCall]:
    if "closed" in row.states:
        yield from _at(row, Skill.OPEN)


PLANNERS: Final[Mapping[BaselineName, Baseline]] = {
    BaselineName.ORACLE: oracle_plan,
    BaselineName.GREEDY: greedy_plan,
    BaselineName.RANDOM: random_plan,
}
"""Baselines of our own world."""
