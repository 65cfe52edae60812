"""Evaluation of formulas against facts, the atoms that are scored, and BDDL text.

Quantifiers range over ``types``: object names by synset, matched exactly. The semantics are those of the ``bddl`` package;
tests compare with its evaluator.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from embomatrix.world.goal import And, Atom, Compound, Facts, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.substances import is_substance

Types = Mapping[str, tuple[str, ...]]
MAX_GROUND: Final = 4_096
"""Atoms of a goal after grounding its quantifiers. The largest goal of BEHAVIOR-1K has 124."""
MAX_ATOMS: Final = 1_024
"""Scored atoms of a goal, which every result lists."""


class GoalError(ValueError):
    """Formula that can't be evaluated: it names an unknown type or an unbound variable."""


def evaluate(formula: Formula, facts: Facts, types: Types) -> bool:
    """Return True if the closed formula holds; queries only deciding facts. Raises GoalError for unknown types."""
    return _holds(formula, facts, types, {})


def _holds(formula: Formula, facts: Facts, types: Types, scope: Mapping[str, str]) -> bool:
    match formula:
        case Atom(predicate, args):
            return facts.holds(predicate, tuple(_resolve(arg, scope) for arg in args))
        case Not(body):
            return not _holds(body, facts, types, scope)
        case And(parts):
            return all(_holds(part, facts, types, scope) for part in parts)
        case Or(parts):
            return any(_holds(part, facts, types, scope) for part in parts)
        case Imply(premise, conclusion):
            return not _holds(premise, facts, types, scope) or _holds(conclusion, facts, types, scope)
        case Quantified():
            hold = _holds_each if len(formula.binders) == 1 else _holds_pairs
            return hold(formula, facts, types, scope)


def _holds_each(formula: Quantified, facts: Facts, types: Types, scope: Mapping[str, str]) -> bool:
    [(variable, type_name)] = formula.binders
    members = _members(type_name, types)
    cases = (_holds(formula.body, facts, types, {**scope, variable: name}) for name in members)
    if formula.quantifier is Quantifier.FORALL:
        return all(cases)
    return any(cases) if formula.quantifier is Quantifier.EXISTS else sum(cases) == formula.count


def _holds_pairs(formula: Quantified, facts: Facts, types: Types, scope: Mapping[str, str]) -> bool:
    """Evaluate a pair quantifier; rows are the objects of the first type.

    A pair of an object with itself has no cell, as in ``bddl``. The columns of a table over one type are the places left in a
    row: one fewer than rows.
    """
    (variable_a, type_a), (variable_b, type_b) = formula.binders
    rows = _members(type_a, types)
    columns = _members(type_b, types)
    table = [
        [
            _holds(formula.body, facts, types, {**scope, variable_a: a, variable_b: b})
            for b in columns
            if b != a
        ]
        for a in rows
    ]  # (rows, columns)
    width = min((len(row) for row in table), default=0)
    needed = min(len(table), width) if formula.count is None else formula.count
    true_rows = sum(any(row) for row in table)
    true_columns = sum(any(row[index] for row in table) for index in range(width))
    return true_rows >= needed and true_columns >= needed


def _resolve(arg: str, scope: Mapping[str, str]) -> str:
    if not arg.startswith("?"):
        return arg
    if arg not in scope:
        raise GoalError(
            f"variable {arg!r} is not bound: expected a quantifier around it, or an object's name"
        )
    return scope[arg]


def _members(type_name: str, types: Types) -> tuple[str, ...]:
    if type_name not in types:
        raise GoalError(f"no objects are known of type {type_name!r}: expected one of {sorted(types)}")
    return types[type_name]


def scored_atoms(formula: Formula, types: Types) -> tuple[Formula, ...]:
    """Scored sub-goals: the conjuncts after grounding ``forall``; any other operator is one of them."""
    match formula:
        case And(parts):
            return tuple(atom for part in parts for atom in scored_atoms(part, types))
        case Quantified(Quantifier.FORALL):
            return scored_atoms(And(instances(formula, types)), types)
        case _:
            return (formula,)


def ground_size(formula: Formula, types: Types) -> int:
    """Return the number of atoms after grounding every quantifier, without grounding any. Raises GoalError.

    A part without an atom counts as one: copies of it need memory too.
    """
    match formula:
        case Atom():
            return 1
        case And(parts) | Or(parts):
            return max(1, sum(ground_size(part, types) for part in parts))
        case Imply(premise, conclusion):
            return ground_size(premise, types) + ground_size(conclusion, types)
        case Not(body):
            return ground_size(body, types)
        case Quantified(_, binders, body):
            members = math.prod(len(_members(type_name, types)) for _, type_name in binders)
            return max(1, members * ground_size(body, types))


def check_size(goal: Formula, types: Types) -> int:
    """Return the number of scored atoms. Raises GoalError for a goal that becomes too many: nested quantifiers multiply."""
    size = ground_size(goal, types)
    if size > MAX_GROUND:
        raise GoalError(
            f"the goal becomes {size:,} atoms: expected at most {MAX_GROUND:,}; nest fewer quantifiers, or name fewer objects"
        )
    scored = len(scored_atoms(goal, types))
    if scored > MAX_ATOMS:
        raise GoalError(f"the goal has {scored:,} scored atoms: expected at most {MAX_ATOMS:,}")
    return scored


def expand(formula: Formula, types: Types) -> Atom | Not | And | Or | Quantified:
    """Rewrite an outermost implication, ``forall`` or ``exists`` with ``not``, ``and`` and ``or``."""
    match formula:
        case Imply(premise, conclusion):
            return Or((Not(premise), conclusion))
        case Quantified(Quantifier.FORALL):
            return And(instances(formula, types))
        case Quantified(Quantifier.EXISTS):
            return Or(instances(formula, types))
        case _:
            return formula


def instance(formula: Quantified, *names: str) -> Formula:
    """Body of a quantifier with these objects as its variables."""
    return substitute(
        formula.body, {variable: name for (variable, _), name in zip(formula.binders, names, strict=True)}
    )


def instances(formula: Quantified, types: Types) -> tuple[Formula, ...]:
    """Bodies of a quantifier with one variable, one for each object of its type."""
    [(_, type_name)] = formula.binders
    return tuple(instance(formula, name) for name in _members(type_name, types))


def pair_sides(formula: Quantified, types: Types) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Objects on both sides of a pair quantifier, and the number of pairs that it needs."""
    rows, columns = (_members(type_name, types) for _, type_name in formula.binders)
    return rows, columns, min(len(rows), len(columns)) if formula.count is None else formula.count


def substitute(formula: Formula, names: Mapping[str, str]) -> Formula:
    """Replace free arguments, variables and objects alike. Quantifiers shadow their variables."""
    if isinstance(formula, Atom):
        return Atom(formula.predicate, tuple(names.get(arg, arg) for arg in formula.args))
    bound = dict(formula.binders) if isinstance(formula, Quantified) else {}
    free = {arg: name for arg, name in names.items() if arg not in bound}
    return _map_children(formula, lambda child: substitute(child, free))


def map_atoms(formula: Formula, change: Callable[[Atom], Formula]) -> Formula:
    """Replace each atom by the result of ``change``."""
    if isinstance(formula, Atom):
        return change(formula)
    return _map_children(formula, lambda child: map_atoms(child, change))


def _map_children(formula: Compound, change: Callable[[Formula], Formula]) -> Formula:
    match formula:
        case And(parts):
            return And(tuple(map(change, parts)))
        case Or(parts):
            return Or(tuple(map(change, parts)))
        case Imply(premise, conclusion):
            return Imply(change(premise), change(conclusion))
        case _:
            return dataclasses.replace(formula, body=change(formula.body))


def subformulas(formula: Formula) -> Iterator[Formula]:
    """Yield the formula and all its subformulas, outermost first."""
    yield formula
    match formula:
        case Atom():
            return
        case And(parts) | Or(parts):
            children = parts
        case Imply(premise, conclusion):
            children = (premise, conclusion)
        case _:
            children = (formula.body,)
    for child in children:
        yield from subformulas(child)


def atoms_of(formula: Formula) -> tuple[Atom, ...]:
    """Every atom in the order of the text; variables stay as they are."""
    return tuple(part for part in subformulas(formula) if isinstance(part, Atom))


def types_of(formula: Formula) -> frozenset[str]:
    """Types that the formula quantifies over."""
    quantified = [part for part in subformulas(formula) if isinstance(part, Quantified)]
    return frozenset(type_name for part in quantified for _, type_name in part.binders)


def objects_of(formula: Formula, types: Types) -> frozenset[str]:
    """Objects that the goal names, and the members of the types it quantifies over.

    Rooms in ``inroom(object, room)`` and substances named by their synset are left out.
    """
    named = {
        arg
        for atom in atoms_of(formula)
        for arg in (atom.args[:1] if atom.predicate == "inroom" else atom.args)
        if not arg.startswith("?") and not is_substance(arg)
    }
    ranged = {name for type_name in types_of(formula) for name in _members(type_name, types)}
    return frozenset(named | {name for name in ranged if not is_substance(name)})


def render(formula: Formula) -> str:
    """BDDL text on one line; ``bddl.parse_formula`` parses it."""
    match formula:
        case Atom(predicate, args):
            return f"({' '.join((predicate, *args))})"
        case Not(body):
            return f"(not {render(body)})"
        case And(parts):
            return f"(and {' '.join(map(render, parts))})" if parts else "(and)"
        case Or(parts):
            return f"(or {' '.join(map(render, parts))})" if parts else "(or)"
        case Imply(premise, conclusion):
            return f"(imply {render(premise)} {render(conclusion)})"
        case Quantified(quantifier, binders, body, count):
            head = [quantifier] if count is None else [quantifier, f"({count})"]
            bound = [f"({variable} - {type_name})" for variable, type_name in binders]
            return f"({' '.join((*head, *bound, render(body)))})"
