"""Reachability of goals by the skills, judged from a problem alone, before any scene or plan exists.

A ground atom can become true or false if a skill of the profile has this effect on objects of its type. A goal with
an atom that does not hold at the start and that no skill achieves is inexpressible.
"""

import functools
import itertools
from collections.abc import Iterator, Mapping
from typing import Final

from embomatrix.factory.writer.categories import REAL
from embomatrix.world.bddl import BddlProblem
from embomatrix.world.catalog import Catalog
from embomatrix.world.evaluate import (
    atoms_of,
    expand,
    instance,
    instances,
    pair_sides,
    render,
    scored_atoms,
    substitute,
)
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
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

INSOURCE: Final = "insource"
FUTURE: Final = "future"
HELD: Final = frozenset((*Relation, *State, *SubstanceRelation, REAL, FUTURE))
"""Predicates that a scene can represent and a goal can use."""
HOUSEHOLD: Final = frozenset((State.SLICED, *MEANINGS, *SubstanceRelation, REAL, FUTURE))
"""Predicates that need skills of the household profile."""


def profile_for(goal: Formula) -> Profile:
    """Return the smaller profile whose skills suffice for a goal."""
    return Profile.HOUSEHOLD if any(atom.predicate in HOUSEHOLD for atom in atoms_of(goal)) else Profile.PAPER


def pieces_of(problem: BddlProblem) -> Mapping[str, tuple[str, ...]]:
    """Return the sliceable objects with their two absent halves."""
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
    """Return the goal's literals that no skill of the profile achieves, as BDDL without repetition.

    A literal with a variable counts if it is unreachable for every value of the variable.
    """
    reachability = Reachability(problem, profile)
    found = [
        render(atom if positive else Not(atom))
        for atom, positive, scope in literals(problem.goal, True, {})
        if not any(
            reachability.possible(substitute(atom, dict(zip(scope, names, strict=True))), positive)
            for names in itertools.product(*(problem.types[type_name] for type_name in scope.values()))
        )
    ]
    return tuple(dict.fromkeys(found))


def literals(
    formula: Formula, positive: bool, scope: Mapping[str, str]
) -> Iterator[tuple[Atom, bool, Mapping[str, str]]]:
    """Yield the atoms with their sign and the types of their variables."""
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
        case Quantified(_, binders, body):
            yield from literals(body, positive, {**scope, **dict(binders)})


class Reachability:
    """Possible effects of a profile's skills on the objects of one problem."""

    def __init__(self, problem: BddlProblem, profile: Profile = Profile.HOUSEHOLD) -> None:
        self._problem = problem
        self._types = problem.types
        self._profile = profile
        self._true = {_canonical(item.atom, problem) for item in problem.init if item.positive}
        self._pieces = pieces_of(problem)
        self._halves = {half for halves in self._pieces.values() for half in halves}

    def unreachable_part(self, formula: Formula) -> Formula | None:
        """Return a conjunct of the goal that can't become true; None if the goal is reachable."""
        conjuncts = scored_atoms(formula, self._types)
        return next((part for part in conjuncts if not self.possible(part)), None)

    def possible(self, formula: Formula, positive: bool = True) -> bool:
        """True if the formula, or its negation, can become true. Its parts are judged independently."""
        match expand(formula, self._types):
            case Atom() as atom:
                return self._reachable(atom)[0 if positive else 1]
            case Not(body):
                return self.possible(body, not positive)
            case And(parts):
                return self._several(parts, positive, every=positive)
            case Or(parts):
                return self._several(parts, positive, every=not positive)
            case Quantified(Quantifier.FORN, count=int(count)) as counted:
                return not positive or self._exactly(count, instances(counted, self._types))
            case Quantified() as pairs:
                return not positive or self._paired(pairs)

    def _several(self, parts: tuple[Formula, ...], positive: bool, *, every: bool) -> bool:
        return (all if every else any)(self.possible(part, positive) for part in parts)

    def _exactly(self, count: int, parts: tuple[Formula, ...]) -> bool:
        always = sum(not self.possible(part, False) for part in parts)
        never = sum(not self.possible(part) for part in parts)
        return always <= count <= len(parts) - never

    def _paired(self, formula: Quantified) -> bool:
        rows, columns, needed = pair_sides(formula, self._types)
        table = [
            [self.possible(instance(formula, row, column)) for column in columns if column != row]
            for row in rows
        ]
        return sum(map(any, table)) >= min(needed, len(table))

    def _reachable(self, atom: Atom) -> tuple[bool, bool]:
        """Return whether the atom can be true at the end, and whether it can be false."""
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
        """Return whether skills can make the atom true, and whether they can make it false."""
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
        """Return the changes to a substance.

        Cleaning removes a covering; soaking adds a liquid to an absorbent object or a vessel.
        """
        if fact.relation is SubstanceRelation.COVERED:
            return False, comes_off(fact.substance)
        holds = "particleRemover" if fact.relation is SubstanceRelation.SATURATED else "fillable"
        takes_up = self._can(name, holds) or (
            fact.relation is SubstanceRelation.SATURATED and self._can(name, "fillable")
        )
        return takes_up and self._is_available(fact.substance), False

    def _is_available(self, substance: str) -> bool:
        """True if the substance is a liquid that an object of the problem holds or gives. Water comes from any tap."""
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
    """Return the atom in canonical form: substances by synset, ``dusty`` and similar states as facts, sources as containers."""
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
