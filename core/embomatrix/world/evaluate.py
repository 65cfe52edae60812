"""Evaluation of formulas against facts, the atoms that are scored, and BDDL text.

Quantifiers range over ``types``: object names by synset, matched exactly. The semantics are those of the ``bddl`` package;
tests compare with its evaluator.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping

from embomatrix.world.goal import (
    And,
    Atom,
    Compound,
    Exists,
    Facts,
    Forall,
    Formula,
    ForN,
    ForPairs,
    Imply,
    Not,
    Or,
)
from embomatrix.world.substances import is_substance

Types = Mapping[str, tuple[str, ...]]


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
        case Forall() | Exists() | ForN():
            return _holds_quantified(formula, facts, types, scope)
        case ForPairs():
            return _holds_pairs(formula, facts, types, scope)


def _holds_quantified(
    formula: Forall | Exists | ForN, facts: Facts, types: Types, scope: Mapping[str, str]
) -> bool:
    members = _members(formula.type, types)
    cases = (_holds(formula.body, facts, types, {**scope, formula.variable: name}) for name in members)
    match formula:
        case Forall():
            return all(cases)
        case Exists():
            return any(cases)
        case ForN(count):
            return sum(cases) == count


def _holds_pairs(formula: ForPairs, facts: Facts, types: Types, scope: Mapping[str, str]) -> bool:
    """Evaluate a pair quantifier; rows are the objects of the first type.

    A pair of an object with itself has no cell, as in ``bddl``. The columns of a table over one type are the places left in a
    row: one fewer than rows.
    """
    rows = _members(formula.type_a, types)
    columns = _members(formula.type_b, types)
    table = [
        [
            _holds(formula.body, facts, types, {**scope, formula.variable_a: a, formula.variable_b: b})
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
        case Forall(variable, type_name, body):
            return tuple(
                atom
                for name in _members(type_name, types)
                for atom in scored_atoms(substitute(body, {variable: name}), types)
            )
        case _:
            return (formula,)


def substitute(formula: Formula, names: Mapping[str, str]) -> Formula:
    """Replace free arguments, variables and objects alike. Quantifiers shadow their variables."""
    if isinstance(formula, Atom):
        return Atom(formula.predicate, tuple(names.get(arg, arg) for arg in formula.args))
    bound = {getattr(formula, field, "") for field in ("variable", "variable_a", "variable_b")}
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
    found: set[str] = set()
    for part in subformulas(formula):
        if isinstance(part, Forall | Exists | ForN):
            found.add(part.type)
        elif isinstance(part, ForPairs):
            found |= {part.type_a, part.type_b}
    return frozenset(found)


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
        case Forall(variable, type_name, body):
            return f"(forall ({variable} - {type_name}) {render(body)})"
        case Exists(variable, type_name, body):
            return f"(exists ({variable} - {type_name}) {render(body)})"
        case ForN(count, variable, type_name, body):
            return f"(forn ({count}) ({variable} - {type_name}) {render(body)})"
        case ForPairs(a, type_a, b, type_b, body, count):
            word = "forpairs" if count is None else f"fornpairs ({count})"
            return f"({word} ({a} - {type_a}) ({b} - {type_b}) {render(body)})"
