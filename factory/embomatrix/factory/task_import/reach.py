"""Which goals the skills can reach, judged from a problem alone: before any scene is at hand, and before any plan is sought.

A ground atom can come true, or become false, when some skill of the household profile does that to things of such a type;
or it is so from the start. What no skill does and the start does not hold makes a goal inexpressible.
"""

from __future__ import annotations

import functools
import itertools
from typing import TYPE_CHECKING, Final

from embomatrix.world.catalog import Catalog
from embomatrix.world.evaluate import atoms_of, render, substitute
from embomatrix.world.goal import (
    And,
    Atom,
    Exists,
    Forall,
    Formula,
    ForN,
    ForNPairs,
    ForPairs,
    Imply,
    Not,
    Or,
)
from embomatrix.world.state import Relation, State, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import (
    MEANINGS,
    WATER,
    SubstanceKind,
    comes_off,
    flows_from,
    half_of,
    is_substance,
    kind_of,
)
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.world.bddl import BddlProblem

INSOURCE: Final = "insource"
REAL, FUTURE = "real", "future"
HELD: Final = frozenset((*Relation, *State, *SubstanceRelation, REAL, FUTURE))
"""Predicates that a scene can hold and a goal can ask for."""
HOUSEHOLD: Final = frozenset((State.SLICED, *MEANINGS, *SubstanceRelation, REAL, FUTURE))
"""Predicates that ask for the household profile's skills."""


def profile_for(goal: Formula) -> Profile:
    """The smaller of the profiles that a goal needs."""
    return Profile.HOUSEHOLD if any(atom.predicate in HOUSEHOLD for atom in atoms_of(goal)) else Profile.PAPER


def pieces_of(problem: BddlProblem) -> Mapping[str, tuple[str, ...]]:
    """Objects that can be sliced, and the absent objects of the problem that are their two halves."""
    future = [item.atom.args[0] for item in problem.init if item.positive and item.atom.predicate == FUTURE]
    waiting: dict[str, list[str]] = {}
    for name in future:
        waiting.setdefault(problem.objects[name], []).append(name)
    found: dict[str, tuple[str, ...]] = {}
    for name, type_name in problem.objects.items():
        halves = waiting.get(half_of(type_name), [])
        if halves and name not in future:
            found[name] = tuple(halves[:2])
            del halves[:2]
    return found


def unreachable_atoms(problem: BddlProblem, profile: Profile) -> tuple[str, ...]:
    """Literals of the goal that no skill of the profile can make hold, in BDDL, each once.

    A literal about a variable counts when that is so for all that the variable ranges over.
    """
    horizon = Reachability(problem, profile)
    found = [
        render(atom if positive else Not(atom))
        for atom, positive, scope in literals(problem.goal, True, {})
        if not any(
            horizon.possible(substitute(atom, dict(zip(scope, names, strict=True))), positive)
            for names in itertools.product(*(problem.types[type_name] for type_name in scope.values()))
        )
    ]
    return tuple(dict.fromkeys(found))


def literals(
    formula: Formula, positive: bool, scope: Mapping[str, str]
) -> Iterator[tuple[Atom, bool, Mapping[str, str]]]:
    """Atoms with their sign, and the types of the variables that they name."""
    match formula:
        case Atom(_, args):
            yield formula, positive, {name: kind for name, kind in scope.items() if name in args}
        case Not(body):
            yield from literals(body, not positive, scope)
        case And(parts) | Or(parts):
            for part in parts:
                yield from literals(part, positive, scope)
        case Imply(premise, conclusion):
            yield from literals(premise, not positive, scope)
            yield from literals(conclusion, positive, scope)
        case Forall(variable, kind, body) | Exists(variable, kind, body) | ForN(_, variable, kind, body):
            yield from literals(body, positive, {**scope, variable: kind})
        case ForPairs(a, kind_a, b, kind_b, body) | ForNPairs(_, a, kind_a, b, kind_b, body):
            yield from literals(body, positive, {**scope, a: kind_a, b: kind_b})


class Reachability:
    """What can become of the objects of one problem by the skills of a profile."""

    def __init__(self, problem: BddlProblem, profile: Profile = Profile.HOUSEHOLD) -> None:
        self._problem = problem
        self._profile = profile
        self._true = {_canonical(item.atom, problem) for item in problem.init if item.positive}
        self._pieces = pieces_of(problem)
        self._halves = {half for halves in self._pieces.values() for half in halves}

    def obstacle(self, formula: Formula) -> Formula | None:
        """A conjunct of the goal that has to come true and can't; None when the goal can be reached."""
        match formula:
            case And(parts):
                return next((found for part in parts if (found := self.obstacle(part))), None)
            case Forall(variable, type_name, body):
                grounded = self._ground(variable, type_name, body)
                return next((found for part in grounded if (found := self.obstacle(part))), None)
            case _:
                return None if self.possible(formula) else formula

    def possible(self, formula: Formula, positive: bool = True) -> bool:
        """Whether the formula, or its negation, can be made to hold, each of its parts taken by itself."""
        match formula:
            case Atom():
                return self._reachable(formula)[0 if positive else 1]
            case Not(body):
                return self.possible(body, not positive)
            case And(parts):
                return self._several(parts, positive, every=positive)
            case Or(parts):
                return self._several(parts, positive, every=not positive)
            case Imply(premise, conclusion):
                return self.possible(Or((Not(premise), conclusion)), positive)
            case Forall(variable, type_name, body):
                return self._several(self._ground(variable, type_name, body), positive, every=positive)
            case Exists(variable, type_name, body):
                return self._several(self._ground(variable, type_name, body), positive, every=not positive)
            case ForN(count, variable, type_name, body):
                return not positive or self._exactly(count, self._ground(variable, type_name, body))
            case ForPairs() | ForNPairs():
                return not positive or self._paired(formula)

    def _several(self, parts: tuple[Formula, ...], positive: bool, *, every: bool) -> bool:
        return (all if every else any)(self.possible(part, positive) for part in parts)

    def _exactly(self, count: int, parts: tuple[Formula, ...]) -> bool:
        always = sum(not self.possible(part, False) for part in parts)
        never = sum(not self.possible(part) for part in parts)
        return always <= count <= len(parts) - never

    def _paired(self, formula: ForPairs | ForNPairs) -> bool:
        rows = self._problem.types[formula.type_a]
        columns = self._problem.types[formula.type_b]
        needed = formula.count if isinstance(formula, ForNPairs) else min(len(rows), len(columns))
        table = [
            [
                self.possible(substitute(formula.body, {formula.variable_a: row, formula.variable_b: column}))
                for column in columns
                if column != row
            ]
            for row in rows
        ]
        return sum(map(any, table)) >= min(needed, len(table))

    def _ground(self, variable: str, type_name: str, body: Formula) -> tuple[Formula, ...]:
        return tuple(substitute(body, {variable: name}) for name in self._problem.types[type_name])

    def _reachable(self, atom: Atom) -> tuple[bool, bool]:
        """Whether the atom can be true in the end, and whether it can be false."""
        if atom.predicate not in HELD:
            return False, False
        known = _canonical(atom, self._problem)
        at_start = known in self._true
        if atom.predicate == REAL:
            at_start = Atom(FUTURE, atom.args) not in self._true
        elif atom.predicate == SubstanceRelation.CONTAINS:
            at_start = at_start or Atom(SubstanceRelation.FILLED.value, known.args) in self._true
        gain, loss = self._changes(known)
        return at_start or gain, not at_start or loss

    def _changes(self, atom: Atom) -> tuple[bool, bool]:
        """Whether skills can make the atom true, and whether they can make it false."""
        predicate, name = atom.predicate, atom.args[0]
        if is_substance(self._type(name)) or (self._profile is Profile.PAPER and predicate in HOUSEHOLD):
            return False, False
        if predicate in set(Relation):
            solid = predicate == Relation.INROOM or not is_substance(self._type(atom.args[1]))
            return solid, solid
        if predicate in set(SubstanceRelation):
            return self._flows(SubstanceFact(SubstanceRelation(predicate), atom.args[1]), name)
        match predicate:
            case State.OPEN | State.TOGGLED_ON | State.HOT | State.FROZEN:
                return True, True
            case State.COOKED:
                return True, False
            case State.SLICED:
                return self._can(name, "sliceable"), False
            case "real":
                return name in self._halves, name in self._pieces
            case _:
                return False, True

    def _flows(self, fact: SubstanceFact, name: str) -> tuple[bool, bool]:
        """Cleaning takes a covering off; soaking leaves a liquid in what takes it up, or in a vessel."""
        if fact.relation is SubstanceRelation.COVERED:
            return False, comes_off(fact.substance)
        holds = "particleRemover" if fact.relation is SubstanceRelation.SATURATED else "fillable"
        takes_up = self._can(name, holds) or (
            fact.relation is SubstanceRelation.SATURATED and self._can(name, "fillable")
        )
        return takes_up and self._is_at_hand(fact.substance), False

    def _is_at_hand(self, substance: str) -> bool:
        """Whether the substance is a liquid that something of the problem holds or gives; water comes from any tap."""
        if kind_of(substance) is not SubstanceKind.LIQUID:
            return False
        holding = (SubstanceRelation.FILLED, SubstanceRelation.CONTAINS)
        held = any(atom.predicate in holding and atom.args[1] == substance for atom in self._true)
        given = any(substance in flows_from(type_name) for type_name in self._problem.objects.values())
        return held or given or substance == WATER

    def _type(self, name: str) -> str:
        return self._problem.objects.get(name, name)

    def _can(self, name: str, ability: str) -> bool:
        return _type_can(self._type(name), ability)


@functools.cache
def _type_can(type_name: str, ability: str) -> bool:
    catalog = Catalog.load()
    return any(ability in catalog.category(name).abilities for name in catalog.categories_of(type_name))


def _canonical(atom: Atom, problem: BddlProblem) -> Atom:
    """The atom in one dialect: substances by their synsets, ``dusty`` and the like as facts about them, sources as holders."""
    names = tuple(
        problem.objects[arg] if is_substance(problem.objects.get(arg, "")) and index else arg
        for index, arg in enumerate(atom.args)
    )
    if atom.predicate in {state.value for state in MEANINGS}:
        fact = MEANINGS[State(atom.predicate)]
        return Atom(fact.relation.value, (names[0], fact.substance))
    if atom.predicate == INSOURCE:
        return Atom(SubstanceRelation.CONTAINS.value, names)
    return Atom(atom.predicate, names)
