"""Task files: an instruction, a goal and objects become a BDDL problem, and each mistake is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.sources import ProblemSourceError
from embomatrix.factory.task_import.task_fields import instruction_of
from embomatrix.factory.task_import.task_file import MAX_BYTES, TaskFile, read_task_file
from embomatrix.world.bddl import InitLiteral, parse_problem
from embomatrix.world.evaluate import render
from embomatrix.world.goal import Atom

TIDY = """
instruction = "Could you put the apple into the fridge in kitchen_0?"
scene = "Rs_int"
goal = "(and (inside apple_1 fridge_1) (not (open fridge_1)))"
[objects]
apple_1 = "ontop table_1"
table_1 = "inroom living_room"
fridge_1 = ["inroom kitchen_0", "open", "not stained"]
"""


def read(tmp_path: Path, text: str, name: str = "tidy.toml") -> TaskFile:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return read_task_file(path)


def test_objects_facts_and_goal_become_a_problem(tmp_path: Path) -> None:
    file = read(tmp_path, TIDY)
    problem = file.problem
    assert problem.objects == {
        "apple_1": "apple.n.01",
        "table_1": "table.n.02",
        "fridge_1": "electric_refrigerator.n.01",
    }
    assert problem.init == (
        InitLiteral(Atom("ontop", ("apple_1", "table_1"))),
        InitLiteral(Atom("inroom", ("table_1", "living_room"))),
        InitLiteral(Atom("inroom", ("fridge_1", "kitchen_0"))),
        InitLiteral(Atom("open", ("fridge_1",))),
        InitLiteral(Atom("stained", ("fridge_1",)), positive=False),
    )
    assert render(problem.goal) == "(and (inside apple_1 fridge_1) (not (open fridge_1)))"
    assert parse_problem(file.source.text) == problem
    assert file.scene == "Rs_int"


def test_names_that_are_categories_bind_that_category_and_general_words_any(tmp_path: Path) -> None:
    assert read(tmp_path, TIDY).categories == {"apple_1": "apple", "fridge_1": "fridge"}


def test_floor_is_the_floor_and_a_bar_is_an_object(tmp_path: Path) -> None:
    text = 'instruction = "i"\ngoal = "(ontop mug_1 bar_1)"\n[objects]\nmug_1 = "ontop floor_1"\nfloor_1 = []\nbar_1 = []\n'
    file = read(tmp_path, text)
    assert file.problem.objects["floor_1"] == "floor.n.01"
    assert "floor_1" not in file.categories
    assert render(read_problem(file.source)[0].goal) == "(ontop mug_1 bar_1)"


def test_instruction_stays_as_it_is_written(tmp_path: Path) -> None:
    file = read(tmp_path, TIDY)
    words = instruction_of(file.source, file.problem, {"kitchen_0": "kitchen_3"})
    assert words == "Could you put the apple into the fridge in kitchen_0?"


def test_scene_file_lies_beside_the_task_file(tmp_path: Path) -> None:
    file = read(tmp_path, TIDY.replace("Rs_int", "scenes/flat.json"))
    assert file.scene == str(tmp_path / "scenes" / "flat.json")


def test_substances_need_no_declaration(tmp_path: Path) -> None:
    text = """instruction = "i"\ngoal = "(not (covered table_1 dust.n.01))"\n[objects]\ntable_1 = "covered dust.n.01"\n"""
    problem = read_problem(read(tmp_path, text).source)[0]
    assert problem.objects == {"table_1": "table.n.02", "dust.n.01": "dust.n.01"}
    assert render(problem.goal) == "(not (covered table_1 dust.n.01))"


def test_quantifiers_range_over_the_objects_of_a_type(tmp_path: Path) -> None:
    goal = "(forall (?m - mug.n.04) (ontop ?m coffee_table_1))"
    file = read(
        tmp_path,
        f'instruction = "i"\ngoal = "{goal}"\n[objects]\nmug_1 = []\nmug_2 = []\ncoffee_table_1 = []\n',
    )
    assert file.problem.types["mug.n.04"] == ("mug_1", "mug_2")


def test_bddl_file_is_read_as_an_import_reads_it(tmp_path: Path) -> None:
    text = read(tmp_path, TIDY).source.text
    file = read(tmp_path, text, "tidy.bddl")
    assert (file.problem, file.scene, file.categories) == (parse_problem(text), "", {})
    with pytest.raises(ProblemSourceError, match=r"open.bddl: line 1, column 1: the parenthesis"):
        read(tmp_path, text.rstrip()[:-1], "open.bddl")


MISTAKES = [
    ("instruction = ", "instrucion = ", "found the key 'instrucion': expected only instruction, goal, objects"),
    ('scene = "Rs_int"\ngoal', '# goal', "found no key 'goal'"),
    ("Could you", "Could\\u0007 you", "instruction: found"),
    ('instruction = "Could', 'instruction = "" # ', "instruction: found ''"),
    ("goal = ", "goal = 3 # ", "goal: found 3: expected text in quotes"),
    ("(not (open fridge_1)))", "(not (open fridge_1))", "goal: line 1, column 1: the parenthesis opened here"),
    ("inside apple_1", "inisde apple_1", "goal: line 1, column 6: unknown predicate 'inisde'"),
    ("inside apple_1", "inside pear_1", "goal: line 1, column 14: object 'pear_1' is not declared: add it to [objects]"),
    ("apple_1 = ", "aple_1 = ", "objects.aple_1: unknown category 'aple'"),
    ("apple_1 = ", "apple = ", "objects.apple: found 'apple': expected a category and a number"),
    ("apple_1 = ", '"Apple 1" = ', "objects.Apple 1: found 'Apple 1': expected a category and a number"),
    ("apple_1 = ", "agent_1 = ", "objects.agent_1: found 'agent_1': expected things only"),
    ("ontop table_1", "on table_1", "objects.apple_1: found 'on table_1': unknown predicate 'on'"),
    ("ontop table_1", "ontop desk_1", "objects.apple_1: found 'ontop desk_1': object 'desk_1' is not declared"),
    ("ontop table_1", "", "objects.apple_1: found '': expected facts such as 'inroom kitchen'"),
    ("ontop table_1", "not", "objects.apple_1: found 'not': expected facts"),
    ("ontop table_1", "ontop) (open", "objects.apple_1: found 'ontop) (open'"),
    ("ontop table_1", "not not open", "objects.apple_1: found 'not not open'"),
    ("ontop table_1", "and", "objects.apple_1: found 'and'"),
    ("inroom kitchen_0", "inroom ktchen", "such as kitchen_0; did you mean kitchen?"),
    ('"inroom kitchen_0", ', "3, ", "objects.fridge_1[0]: found 3"),
    ("[objects]", "[rooms]\n[objects]", "this file is a floor plan, for `embomatrix scene build`"),
    ("[objects]", "[objects]\napple_1 = ", "is not TOML"),
]  # fmt: skip


@pytest.mark.parametrize(("part", "wrong", "words"), MISTAKES, ids=[wrong for _, wrong, _ in MISTAKES])
def test_mistake_is_named_with_file_key_and_expectation(
    tmp_path: Path, part: str, wrong: str, words: str
) -> None:
    assert part in TIDY
    with pytest.raises(ProblemSourceError) as caught:
        read(tmp_path, TIDY.replace(part, wrong))
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "tidy.toml"))


def test_goal_of_too_many_atoms_is_refused(tmp_path: Path) -> None:
    mugs = "".join(f"mug_{n} = []\n" for n in range(90))
    goal = "(forall (?a - mug.n.04) (forall (?b - mug.n.04) (nextto ?a ?b)))"
    with pytest.raises(ProblemSourceError, match=r"tidy.toml: goal: .*atoms"):
        read(tmp_path, f'instruction = "i"\ngoal = "{goal}"\n[objects]\n{mugs}')


def test_file_without_objects_or_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProblemSourceError, match="objects: found 0 objects"):
        read(tmp_path, 'instruction = "i"\ngoal = "(and)"\n[objects]\n')
    (tmp_path / "big.toml").write_bytes(b"#" * (MAX_BYTES + 1))
    for name in ("big.toml", "nothing.toml", "nothing.bddl"):
        with pytest.raises(ProblemSourceError, match=name):
            read_task_file(tmp_path / name)
