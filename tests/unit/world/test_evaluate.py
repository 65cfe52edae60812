"""Semantics of formulas, and the reward's atoms as conjuncts of the goal."""

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.formulas import forall

from embomatrix.world.bddl import parse_formula
from embomatrix.world.evaluate import (
    GoalError,
    atoms_of,
    check_size,
    evaluate,
    ground_size,
    objects_of,
    render,
    scored_atoms,
    substitute,
    types_of,
)
from embomatrix.world.goal import Atom, Formula

OBJECTS = {"apple_1": "apple", "apple_2": "apple", "box_1": "box", "box_2": "box", "lamp_1": "lamp"}
TYPES = {"apple": ("apple_1", "apple_2"), "box": ("box_1", "box_2"), "lamp": ("lamp_1",)}


@dataclass
class Table:
    """Set of true facts; ``asked`` counts the queries."""

    true: set[tuple[str, ...]] = field(default_factory=set)
    asked: int = 0

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        self.asked += 1
        return (predicate, *args) in self.true


def facts(*atoms: str) -> Table:
    return Table({tuple(atom.split()) for atom in atoms})


def goal(text: str) -> Formula:
    return parse_formula(text, OBJECTS)


EVERY = "(forall (?x - apple) (inside ?x box_1))"
PAIRS = "(forpairs (?x - apple) (?y - box) (inside ?x ?y))"


@pytest.mark.parametrize(
    ("text", "true", "expected"),
    [
        ("(open box_1)", ["open box_1"], True),
        ("(not (open box_1))", [], True),
        ("(and)", [], True),
        ("(or)", [], False),
        ("(or (open box_1) (open box_2))", ["open box_2"], True),
        ("(imply (open box_1) (open box_2))", [], True),
        ("(imply (open box_1) (open box_2))", ["open box_1"], False),
        (EVERY, ["inside apple_1 box_1"], False),
        (EVERY, ["inside apple_1 box_1", "inside apple_2 box_1"], True),
        ("(exists (?x - apple) (inside ?x box_1))", ["inside apple_2 box_1"], True),
        ("(forn (1) (?x - apple) (hot ?x))", ["hot apple_1"], True),
        ("(forn (1) (?x - apple) (hot ?x))", ["hot apple_1", "hot apple_2"], False),
        (PAIRS, ["inside apple_1 box_1", "inside apple_2 box_2"], True),
        (PAIRS, ["inside apple_1 box_1", "inside apple_2 box_1"], False),
        ("(fornpairs (1) (?x - apple) (?y - box) (inside ?x ?y))", ["inside apple_2 box_1"], True),
        ("(forpairs (?x - apple) (?y - apple) (nextto ?x ?y))", ["nextto apple_1 apple_2"], True),
        ("(forpairs (?x - lamp) (?y - lamp) (nextto ?x ?y))", ["nextto lamp_1 lamp_1"], True),
    ],
)
def test_formula_holds_or_not(text: str, true: list[str], expected: bool) -> None:
    assert evaluate(goal(text), facts(*true), TYPES) is expected


def test_only_deciding_facts_are_queried() -> None:
    table = facts("open box_1")
    assert evaluate(goal("(or (open box_1) (open box_2) (hot lamp_1))"), table, TYPES)
    assert table.asked == 1


def test_inner_variable_shadows_the_outer_one() -> None:
    formula = goal("(forall (?x - box) (and (open ?x) (exists (?x - apple) (hot ?x))))")
    assert evaluate(formula, facts("open box_1", "open box_2", "hot apple_1"), TYPES)
    assert [render(atom) for atom in scored_atoms(formula, TYPES)] == [
        "(open box_1)",
        "(exists (?x - apple) (hot ?x))",
        "(open box_2)",
        "(exists (?x - apple) (hot ?x))",
    ]


def test_scored_atoms_are_conjuncts_after_grounding_and_other_operators_count_once() -> None:
    formula = goal(f"(and {EVERY} (and (not (open box_1)) (or (hot lamp_1) (open box_2))) {PAIRS})")
    assert [render(atom) for atom in scored_atoms(formula, TYPES)] == [
        "(inside apple_1 box_1)",
        "(inside apple_2 box_1)",
        "(not (open box_1))",
        "(or (hot lamp_1) (open box_2))",
        PAIRS,
    ]


@pytest.mark.parametrize("text", ["(or)", "(and)"])
def test_nested_quantifiers_over_nothing_are_refused_before_they_are_grounded(text: str) -> None:
    formula = goal(text)
    for number in range(40):
        formula = forall(f"?x{number}", "apple", formula)
    with pytest.raises(GoalError, match="1,099,511,627,776 atoms"):
        check_size(formula, TYPES)


def test_unknown_type_and_free_variable_are_named() -> None:
    with pytest.raises(GoalError, match="'pear'"):
        evaluate(forall("?x", "pear", Atom("hot", ("?x",))), facts(), TYPES)
    with pytest.raises(GoalError, match=r"'\?x' is not bound"):
        evaluate(Atom("hot", ("?x",)), facts(), TYPES)


def test_objects_of_a_goal_include_named_and_quantified_ones() -> None:
    formula = goal(f"(and {EVERY} (inroom lamp_1 kitchen_0))")
    assert objects_of(formula, TYPES) == {"apple_1", "apple_2", "box_1", "lamp_1"}
    assert types_of(formula) == {"apple"}
    assert [atom.predicate for atom in atoms_of(formula)] == ["inside", "inroom"]


def test_substitution_replaces_objects_but_not_bound_variables() -> None:
    renamed = substitute(goal(EVERY), {"box_1": "crate_7", "?x": "wrong"})
    assert render(renamed) == "(forall (?x - apple) (inside ?x crate_7))"


@given(st.sets(st.tuples(st.just("inside"), st.sampled_from(TYPES["apple"]), st.sampled_from(TYPES["box"]))))
def test_conjunction_holds_exactly_when_all_its_scored_atoms_do(true: set[tuple[str, ...]]) -> None:
    formula = goal(f"(and {EVERY} (exists (?y - box) (inside apple_1 ?y)))")
    table = Table(true)
    parts = [evaluate(atom, table, TYPES) for atom in scored_atoms(formula, TYPES)]
    assert evaluate(formula, table, TYPES) is all(parts)


def nested(depth: int, quantifier: str = "forall") -> Formula:
    """Return a goal of this many quantifiers in each other."""
    text = "(hot ?x0)"
    for number in range(depth):
        text = f"({quantifier} (?x{number} - apple) {text})"
    return parse_formula(text, OBJECTS)


@pytest.mark.parametrize("quantifier", ["forall", "exists"])
def test_size_of_a_goal_is_known_without_grounding_it(quantifier):
    assert ground_size(nested(3, quantifier), TYPES) == 2**3
    with pytest.raises(GoalError, match=r"becomes 1,152,921,504,606,846,976 atoms: expected at most 4,096"):
        check_size(nested(60, quantifier), TYPES)


def test_goal_with_more_scored_atoms_than_a_result_may_list_is_refused():
    check_size(nested(10), TYPES)
    with pytest.raises(GoalError, match="2,048 scored atoms: expected at most 1,024"):
        check_size(nested(11), TYPES)
