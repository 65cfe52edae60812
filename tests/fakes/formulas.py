"""Quantified formulas, written as in BDDL."""

from embomatrix.world.goal import Formula, Quantified, Quantifier


def forall(variable: str, type_name: str, body: Formula) -> Quantified:
    return Quantified(Quantifier.FORALL, ((variable, type_name),), body)


def exists(variable: str, type_name: str, body: Formula) -> Quantified:
    return Quantified(Quantifier.EXISTS, ((variable, type_name),), body)


def forn(count: int, variable: str, type_name: str, body: Formula) -> Quantified:
    return Quantified(Quantifier.FORN, ((variable, type_name),), body, count)


def forpairs(
    variable_a: str, type_a: str, variable_b: str, type_b: str, body: Formula, count: int | None = None
) -> Quantified:
    """``fornpairs`` with a count."""
    quantifier = Quantifier.FORPAIRS if count is None else Quantifier.FORNPAIRS
    return Quantified(quantifier, ((variable_a, type_a), (variable_b, type_b)), body, count)
