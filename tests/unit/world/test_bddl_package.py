"""Parsing and evaluation agree with the bddl package."""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.formulas import exists, forall, forn, forpairs

from embomatrix.world.bddl import WILDCARD, BddlProblem, InitLiteral, parse_problem, render_problem
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified

bddl = pytest.importorskip("bddl", reason="the bddl package is not installed")
FOLDER = Path(bddl.__file__).parent / "activity_definitions"
ACTIVITIES = sorted(path.parent.name for path in FOLDER.glob("*/problem0.bddl"))
SEVERAL_EXPRESSIONS = "loading_the_car"
"""Its goal has two expressions. The bddl package drops the second; we take both."""
UNARY = {
    "cooked",
    "frozen",
    "open",
    "folded",
    "unfolded",
    "toggled_on",
    "hot",
    "on_fire",
    "future",
    "real",
    "broken",
}


def text_of(activity: str) -> str:
    return (FOLDER / activity / "problem0.bddl").read_text()


def lists_of(formula: Formula) -> list[Any]:
    """Return a formula as the nested lists that the bddl package parses, without question marks."""
    match formula:
        case Atom(predicate, args):
            return [predicate, *(arg.lstrip("?") for arg in args)]
        case Not(body):
            return ["not", lists_of(body)]
        case And(parts) | Or(parts):
            return ["and" if isinstance(formula, And) else "or", *map(lists_of, parts)]
        case Imply(premise, conclusion):
            return ["imply", lists_of(premise), lists_of(conclusion)]
        case Quantified(quantifier, binders, body, count):
            head = [quantifier.value] if count is None else [quantifier.value, [str(count)]]
            bound = [[variable.lstrip("?"), "-", kind] for variable, kind in binders]
            return [*head, *bound, lists_of(body)]


def unmarked(nested: Any) -> Any:
    return nested.lstrip("?") if isinstance(nested, str) else [unmarked(item) for item in nested]


def test_every_activity_parses_as_in_the_bddl_package() -> None:
    from bddl.parsing import parse_problem as parse_by_package

    for activity in ACTIVITIES:
        _, objects, init, goal = parse_by_package(activity, 0, "omnigibson")
        ours = parse_problem(text_of(activity))
        members = {kind: dict.fromkeys(names) for kind, names in objects.items()}
        spelt = {
            kind: [name for name in names if not name.endswith(WILDCARD)] for kind, names in members.items()
        }
        assert {kind: [*names] for kind, names in ours.types.items()} == spelt, activity
        wildcards = {name for names in members.values() for name in names if name.endswith(WILDCARD)}
        assert set(ours.wildcards) == wildcards, activity
        found = [lists_of(item.atom if item.positive else Not(item.atom)) for item in ours.init]
        assert found == unmarked(init), activity
        formula = ours.goal
        if activity == SEVERAL_EXPRESSIONS:
            assert isinstance(formula, And)
            formula = formula.parts[0]
        conjuncts = formula.parts if isinstance(formula, And) else (formula,)
        assert [*map(lists_of, conjuncts)] == unmarked(goal), activity
    assert len(ACTIVITIES) == 1016


@dataclass(frozen=True)
class Coin:
    """Facts by hash: every atom has a fixed truth value, true with a probability of ``percent``."""

    seed: int
    percent: int

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        key = f"{self.seed} {predicate} {' '.join(args)}".encode()
        return hashlib.sha256(key).digest()[0] % 100 < self.percent


@dataclass(frozen=True)
class Thing:
    name: str


class Package:
    """Evaluator of the bddl package over mutable facts: goals are compiled once."""

    def __init__(self, activity: str, text: str) -> None:
        from bddl.activity import Conditions, get_goal_conditions, get_object_scope

        self.facts: Coin = Coin(0, 50)
        self.conditions = Conditions(activity, 0, "omnigibson", predefined_problem=text)
        scope = {name: Thing(name) for name in get_object_scope(self.conditions)}
        self.goal = get_goal_conditions(self.conditions, self, scope, generate_ground_options=False)

    def get_predicate_class(self, predicate: str) -> type[Any]:
        from bddl.logic_base import BinaryAtomicFormula, UnaryAtomicFormula

        def one(_: Any, a: Thing) -> bool:
            return self.facts.holds(predicate, (a.name,))

        def two(_: Any, a: Thing, b: Thing) -> bool:
            return self.facts.holds(predicate, (a.name, b.name))

        parent = UnaryAtomicFormula if predicate in UNARY else BinaryAtomicFormula
        body = {"STATE_NAME": predicate, "_evaluate": one if predicate in UNARY else two}
        return type(predicate, (parent,), {**body, "_sample": lambda *_: None})

    def verdict(self, facts: Coin) -> bool:
        from bddl.activity import evaluate_goal_conditions

        self.facts = facts
        return bool(evaluate_goal_conditions(self.goal)[0])


def test_every_activity_evaluates_as_in_the_bddl_package_in_six_states() -> None:
    verdicts: list[bool] = []
    for number, activity in enumerate(ACTIVITIES):
        formula = parse_problem(text_of(activity)).goal
        if activity == SEVERAL_EXPRESSIONS and isinstance(formula, And):
            formula = formula.parts[0]
        package = Package(activity, text_of(activity))
        # To the package, which does not spell wildcards out, each is one more object.
        types = {
            kind: tuple(dict.fromkeys(names)) for kind, names in package.conditions.parsed_objects.items()
        }
        for percent in (20, 50, 80, 93, 98, 100):
            facts = Coin(number, percent)
            expected = package.verdict(facts)
            assert evaluate(formula, facts, types) is expected, (activity, percent)
            verdicts.append(expected)
    assert len(verdicts) == 6 * 1016
    assert 1000 < sum(verdicts) < 5000, "both verdicts are common, so agreement means something"


OBJECTS = {
    "apple_1": "apple",
    "apple_2": "apple",
    "apple_3": "apple",
    "box_1": "box",
    "box_2": "box",
    "lamp_1": "lamp",
}
KINDS = ("apple", "box", "lamp")


@st.composite
def formulas(draw: st.DrawFn, scope: tuple[str, ...] = (), depth: int = 3) -> Formula:
    """Generate closed formulas of every operator, with unique variable names."""
    names = st.sampled_from([*OBJECTS, *scope, *scope])
    operator = draw(st.integers(0, 10)) if depth else draw(st.integers(0, 1))
    variables = (f"?v{len(scope)}", f"?v{len(scope) + 1}")
    kinds = st.sampled_from(KINDS)

    def inner(*bound: str) -> Formula:
        return draw(formulas((*scope, *bound), depth - 1))

    match operator:
        case 0:
            return Atom(draw(st.sampled_from(["open", "hot"])), (draw(names),))
        case 1:
            return Atom(draw(st.sampled_from(["inside", "ontop"])), (draw(names), draw(names)))
        case 2:
            return Not(inner())
        case 3:
            return And(tuple(inner() for _ in range(draw(st.integers(1, 3)))))
        case 4:
            return Or(tuple(inner() for _ in range(draw(st.integers(1, 3)))))
        case 5:
            return Imply(inner(), inner())
        case 6:
            return forall(variables[0], draw(kinds), inner(variables[0]))
        case 7:
            return exists(variables[0], draw(kinds), inner(variables[0]))
        case 8:
            return forn(draw(st.integers(0, 3)), variables[0], draw(kinds), inner(variables[0]))
        case 9:
            return forpairs(variables[0], draw(kinds), variables[1], draw(kinds), inner(*variables))
        case _:
            count = draw(st.integers(0, 2))
            return forpairs(variables[0], draw(kinds), variables[1], draw(kinds), inner(*variables), count)


@settings(max_examples=300, deadline=None)
@given(formulas(), st.integers(0, 2**32), st.sampled_from((10, 30, 50, 70, 90)))
def test_formulas_of_all_ten_operators_hold_in_the_same_states(
    goal: Formula, seed: int, percent: int
) -> None:
    problem = BddlProblem("p-0", OBJECTS, (InitLiteral(Atom("open", ("box_1",))),), goal)
    facts = Coin(seed, percent)
    expected = Package("p", render_problem(problem)).verdict(facts)
    assert evaluate(goal, facts, problem.types) is expected


def test_types_of_a_problem_keep_the_order_of_the_text() -> None:
    shuffled = re.sub(r"\s+", " ", render_problem(BddlProblem("p-0", OBJECTS, (), And(()))))
    assert list(parse_problem(shuffled).types) == [*KINDS]
