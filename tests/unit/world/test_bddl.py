"""The parser accepts both dialects; errors name line and column."""

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.formulas import exists, forall, forn, forpairs

from embomatrix.world.bddl import BddlError, BddlProblem, parse_formula, parse_problem, render_problem
from embomatrix.world.evaluate import render
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or

SAMPLE = Path(__file__).parents[4] / "shared" / "data" / "embomatrix_tasks_sample.jsonl"

TIDY = """(define (problem Tidy_the_Apples)
    (:domain omnigibson)
    ; two apples lie about
    (:objects
        Apple.n.01_1 apple.n.01_2 - apple.n.01
        basket.n.01_1 - basket.n.01
        floor.n.01_1 - floor.n.01
        agent.n.01_1 - agent.n.01
    )
    (:init
        (ontop apple.n.01_1 floor.n.01_1)  ; the first
        (not (open basket.n.01_1))
        (inroom floor.n.01_1 kitchen_0)
        (inroom basket.n.01_1 living_room)
    )
    (:goal
        (and
            (forall (?apple.n.01 - apple.n.01) (inside ?apple.n.01 ?basket.n.01_1))
            (not (OnTop apple.n.01_1 ?floor.n.01_1))
        )
    )
)
"""


def bddl_activities() -> Iterator[Path]:
    bddl = pytest.importorskip("bddl", reason="the bddl package is not installed")
    folder = Path(bddl.__file__).parent / "activity_definitions"
    return (path for path in sorted(folder.glob("*/problem*.bddl")))


def test_problem_is_read_into_values() -> None:
    problem = parse_problem(TIDY)
    assert problem.name == "Tidy_the_Apples"
    assert problem.types["apple.n.01"] == ("apple.n.01_1", "apple.n.01_2")
    assert [item.positive for item in problem.init] == [True, False, True, True]
    assert problem.init[3].atom == Atom("inroom", ("basket.n.01_1", "living_room"))
    assert problem.goal == And(
        (
            forall("?apple.n.01", "apple.n.01", Atom("inside", ("?apple.n.01", "basket.n.01_1"))),
            Not(Atom("ontop", ("apple.n.01_1", "floor.n.01_1"))),
        )
    )


WILD = TIDY.replace("basket.n.01_1 - basket", "basket.n.01_1 basket.n.01_* - basket").replace(
    "(inroom basket.n.01_1 living_room)",
    "(inroom basket.n.01_1 living_room) (inroom basket.n.01_* living_room)",
)


def test_wildcard_expands_to_objects_of_the_known_room() -> None:
    problem = parse_problem(WILD)
    assert problem.wildcards == {"basket.n.01_*": "living_room"}
    assert problem.types["basket.n.01"] == ("basket.n.01_1",)
    spelt = problem.spelt_out({"basket.n.01_*": ("basket.n.01_2", "basket.n.01_3")})
    assert spelt.types["basket.n.01"] == ("basket.n.01_1", "basket.n.01_2", "basket.n.01_3")
    assert [item.atom.args for item in spelt.init[-3:]] == [
        (f"basket.n.01_{number}", "living_room") for number in (1, 2, 3)
    ]
    assert not spelt.wildcards
    assert problem.spelt_out({"basket.n.01_*": ()}) == parse_problem(TIDY)
    assert parse_problem(render_problem(problem)) == problem


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("(not (OnTop apple.n.01_1", "(not (OnTop basket.n.01_*"),
        ("(inroom basket.n.01_*", "(ontop basket.n.01_*"),
    ],
)
def test_wildcard_outside_inroom_is_refused(old: str, new: str) -> None:
    with pytest.raises(BddlError, match="wildcard"):
        parse_problem(WILD.replace(old, new).replace("_* living_room", "_* floor.n.01_1"))


def test_substance_is_named_by_its_synset() -> None:
    formula = parse_formula("(not (covered x dust.n.01))", {"x": "plate"})
    assert formula == Not(Atom("covered", ("x", "dust.n.01")))
    for text in ("(covered x dusk.n.01)", "(ontop x dust.n.01)", "(covered dust.n.01 dust.n.01)"):
        with pytest.raises(BddlError, match="not declared"):
            parse_formula(text, {"x": "plate"})


def test_goal_of_several_expressions_is_their_conjunction() -> None:
    text = TIDY.replace("(:goal\n        (and", "(:goal (open basket.n.01_1) (and")
    goal = parse_problem(text).goal
    assert isinstance(goal, And)
    assert goal.parts[0] == Atom("open", ("basket.n.01_1",))


ERRORS: dict[str, tuple[str, str, str, int]] = {
    "missing parenthesis in init": (
        "(inroom basket.n.01_1 living_room)",
        "(inroom basket.n.01_1 living_room",
        "missing before",
        16,
    ),
    "missing parenthesis at the end": ("        )\n    )\n)\n", "        )\n    )\n", "never closed", 1),
    "one parenthesis too many": ("        )\n    )\n)\n", "        )\n    )\n))\n", "after the last", 22),
    "unknown section": ("(:init", "(:initial", "unknown section ':initial'", 10),
    "section twice": ("(:domain omnigibson)", "(:goal (open basket.n.01_1))", "twice", 16),
    "undeclared object": (
        "inside ?apple.n.01 ?basket.n.01_1",
        "inside ?apple.n.01 ?box.n.01_1",
        "'box.n.01_1' is not declared",
        18,
    ),
    "unknown predicate": ("(OnTop", "(hovering", "unknown predicate 'hovering'", 19),
    "wrong number of arguments": (
        "(not (open basket.n.01_1))",
        "(open basket.n.01_1 floor.n.01_1)",
        "the number of arguments of 'open' is 2: expected 1",
        12,
    ),
    "unknown type": (
        "(?apple.n.01 - apple.n.01)",
        "(?pear.n.01 - pear.n.01)",
        "unknown type 'pear.n.01'",
        18,
    ),
    "object without a type": ("- agent.n.01\n", "\n", "has no type", 8),
    "hyphen without a type": ("agent.n.01_1 - agent.n.01", "agent.n.01_1 -", "around this hyphen", 8),
    "one name for two types": ("basket.n.01_1 - basket", "apple.n.01_2 - basket", "declared as", 6),
    "binder without a mark": (
        "(?apple.n.01 - apple.n.01)",
        "(apple.n.01 - apple.n.01)",
        "a variable and its type",
        18,
    ),
    "negation of two": (
        "(not (OnTop",
        "(not (open basket.n.01_1) (OnTop",
        "the number of parts of 'not' is 2: expected 1",
        19,
    ),
    "word for a formula": ("(and\n", "(and apple.n.01_1\n", "expected (PREDICATE", 17),
    "list for an argument": ("(OnTop apple.n.01_1", "(OnTop (apple.n.01_1)", "found a list", 19),
    "no define": ("(define ", "(defun ", "expected '(define", 1),
    "no name": ("(problem Tidy_the_Apples)", "(problem)", "(problem NAME)", 1),
}


@pytest.mark.parametrize("name", ERRORS)
def test_error_names_the_line(name: str) -> None:
    old, new, message, line = ERRORS[name]
    assert old in TIDY
    with pytest.raises(BddlError) as caught:
        parse_problem(TIDY.replace(old, new, 1))
    assert message in str(caught.value)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"line {line}, column {caught.value.column}:")


def test_goal_whose_quantifiers_multiply_is_refused() -> None:
    nested = "(forall (?a - apple.n.01) " * 40 + "(cooked ?a)" + ")" * 40
    with pytest.raises(BddlError, match=r"line 1, column \d+: the goal becomes 1,099,511,627,776 atoms"):
        parse_problem(f"(define (problem x) (:objects a b - apple.n.01) (:init ) (:goal {nested}))")


def test_problem_of_many_objects_is_read_in_linear_time() -> None:
    began_s = time.process_time()
    names = " ".join(f"a{number}" for number in range(100_000))
    problem = parse_problem(f"(define (problem x) (:objects {names} - apple) (:init ) (:goal (hot a1)))")
    assert len(problem.types["apple"]) == 100_000
    assert time.process_time() - began_s < 10.0


def test_column_points_at_the_word() -> None:
    with pytest.raises(BddlError) as caught:
        parse_formula("(and (open a)\n     (hot b))", {"a": "x"})
    assert (caught.value.line, caught.value.column) == (2, 11)


@pytest.mark.parametrize("text", ["", "   ; nothing\n", "apple", ")", "()", "(" * 10_000, "(define)"])
def test_nonsense_is_refused_with_an_explanation(text: str) -> None:
    with pytest.raises(BddlError):
        parse_problem(text)


@given(st.text(alphabet="()?-:;. \nandforallnotdefineobjectsgoalinit_1", max_size=200))
def test_garbage_raises_only_parser_errors(text: str) -> None:
    with pytest.raises(BddlError):
        parse_problem(text)


@given(st.integers(0, len(TIDY) - 1), st.sampled_from(["", "(", ")", " ", "?", "x"]))
def test_text_with_one_changed_character_parses_or_raises_parser_error(position: int, character: str) -> None:
    text = TIDY[:position] + character + TIDY[position + 1 :]
    with contextlib.suppress(BddlError):
        parse_problem(text)


OBJECTS = {"a_1": "a", "a_2": "a", "b_1": "b"}


def formulas() -> st.SearchStrategy[Formula]:
    names = st.sampled_from([*OBJECTS, "?v"])
    atoms = st.builds(lambda p, x: Atom(p, (x,)), st.sampled_from(["open", "hot"]), names) | st.builds(
        lambda p, x, y: Atom(p, (x, y)), st.sampled_from(["inside", "ontop"]), names, names
    )
    types = st.sampled_from(["a", "b"])

    def grow(inner: st.SearchStrategy[Formula]) -> st.SearchStrategy[Formula]:
        several = st.lists(inner, max_size=3).map(tuple)
        return st.one_of(
            st.builds(Not, inner),
            st.builds(And, several),
            st.builds(Or, several),
            st.builds(Imply, inner, inner),
            st.builds(forall, st.just("?v"), types, inner),
            st.builds(exists, st.just("?w"), types, inner),
            st.builds(forn, st.integers(0, 9), st.just("?v"), types, inner),
            st.builds(forpairs, st.just("?v"), types, st.just("?w"), types, inner),
            st.builds(forpairs, st.just("?v"), types, st.just("?w"), types, inner, st.integers(0, 9)),
        )

    return st.recursive(atoms, grow, max_leaves=8).map(lambda body: forall("?v", "a", body))


@given(formulas())
def test_rendered_formula_parses_to_an_equal_one(formula: Formula) -> None:
    assert parse_formula(render(formula), OBJECTS) == formula


@given(formulas())
def test_rendered_problem_parses_to_an_equal_one(goal: Formula) -> None:
    problem = BddlProblem("p", OBJECTS, parse_problem(TIDY).init[:0], goal)
    assert parse_problem(render_problem(problem)) == problem


def test_every_activity_of_behavior_1k_parses() -> None:
    problems = [parse_problem(path.read_text()) for path in bddl_activities()]
    assert len(problems) >= 1016
    assert all(parse_problem(render_problem(problem)).goal == problem.goal for problem in problems)


@pytest.mark.skipif(
    not SAMPLE.exists(), reason="the sample of the paper's tasks is not beside the repository"
)
def test_every_task_of_the_paper_s_factory_parses() -> None:
    texts = [json.loads(line)["bddl"] for line in SAMPLE.read_text().splitlines()]
    problems = [parse_problem(text) for text in texts]
    assert len(problems) == 400
    for problem in problems:
        again = parse_problem(render_problem(problem))
        assert (again.name, again.init, again.goal) == (problem.name, problem.init, problem.goal)
