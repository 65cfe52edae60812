"""Goals: formulas over ground atoms, evaluated lazily against facts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
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


class Quantifier(StrEnum):
    """Quantifiers in the words of BDDL; the last two range over pairs of objects."""

    FORALL = "forall"
    EXISTS = "exists"
    FORN = "forn"
    """Exactly ``count`` objects satisfy the body."""
    FORPAIRS = "forpairs"
    """``fornpairs`` with the smaller number of objects as the count."""
    FORNPAIRS = "fornpairs"
    """The truth table over A x B has a true cell in at least ``count`` rows and as many columns."""


@dataclass(frozen=True, slots=True)
class Quantified:
    """Quantifier and its body. ``binders`` are its variables with their types: one, or two for pairs.

    ``count`` is a number for ``forn`` and ``fornpairs``, else None.
    """

    quantifier: Quantifier
    binders: tuple[tuple[str, str], ...]
    body: Formula
    count: int | None = None


Compound = Not | And | Or | Imply | Quantified
Formula = Atom | Compound
