"""Goals: formulas over ground atoms, evaluated lazily against facts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Facts(Protocol):
    """Source of facts: the engine's state, or a table in a test."""

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool: ...


@dataclass(frozen=True, slots=True)
class Atom:
    """``predicate(args)``. Arguments are object or room names; those that start with "?" are bound variables."""

    predicate: str
    args: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Not:
    body: Formula


@dataclass(frozen=True, slots=True)
class And:
    parts: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Or:
    parts: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Imply:
    premise: Formula
    conclusion: Formula


@dataclass(frozen=True, slots=True)
class Forall:
    variable: str
    type: str
    body: Formula


@dataclass(frozen=True, slots=True)
class Exists:
    variable: str
    type: str
    body: Formula


@dataclass(frozen=True, slots=True)
class ForN:
    """Exactly ``count`` objects of the type satisfy the body."""

    count: int
    variable: str
    type: str
    body: Formula


@dataclass(frozen=True, slots=True)
class ForPairs:
    """Quantifier over pairs: at least ``count`` rows and as many columns of the truth table over A x B hold a true cell.

    Without a count, it is the smaller number of objects: BDDL writes ``forpairs``, and ``fornpairs`` with a count.
    """

    variable_a: str
    type_a: str
    variable_b: str
    type_b: str
    body: Formula
    count: int | None = None


Compound = Not | And | Or | Imply | Forall | Exists | ForN | ForPairs
Formula = Atom | Compound
