"""docs/rewards.md agrees with the code: constants are the defaults, and the example is recomputed."""

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from embomatrix.reward.hierarchy import score
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.world.bddl import parse_problem
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import And, Atom
from embomatrix.world.task import Task, TaskCategory

PAGE = (Path(__file__).parents[3] / "docs" / "rewards.md").read_text(encoding="utf-8")


def rows(first_heading: str) -> list[list[str]]:
    """Return the cells of the table whose first column has this heading."""
    found = re.search(rf"^\| {first_heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/rewards.md has no table of {first_heading}"
    return [line.strip("|").split(" | ") for line in found[1].splitlines()]


def example() -> Task:
    """Return the page's problem as a task whose table contains all of its objects."""
    text = re.search(r"```lisp\n(.*?)```", PAGE, re.DOTALL)
    assert text
    problem = parse_problem(text[1])
    table = tuple(problem.objects)
    return Task("t", "s", "", TaskCategory.PICK_AND_PLACE, problem.goal, text[1], table, types=problem.types)


class Holding:
    """Facts that hold exactly the given atoms, written as on the page."""

    def __init__(self, atoms: list[str]) -> None:
        self.atoms = atoms

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        return " ".join((predicate, *args)) in self.atoms


def test_page_lists_every_constant_with_its_value():
    written = {name.strip(" `"): float(value) for name, value, _ in rows("constant")}
    assert written == dataclasses.asdict(PAPER)


@pytest.mark.parametrize("row", rows("what the plan does"), ids=lambda row: row[0].strip())
def test_example_earns_the_reward_on_the_page(row: list[str]):
    story, touched, true, *numbers = row
    facts = Holding(re.findall(r"`(.+?)`", true))
    task = example()
    breakdown = score(task, frozenset(re.findall(r"`(.+?)`", touched)), facts)
    found = (breakdown.format, breakdown.relevance, breakdown.goal, breakdown.total)
    assert found == pytest.approx([float(number) for number in numbers])
    assert breakdown.success is ("success" in story)


def test_example_task_is_admissible():
    task = example()
    assert not evaluate(task.goal, Holding([]), task.types)
    atoms = score(task, frozenset(), Holding([])).atoms
    assert 2 * sum(atom.holds for atom in atoms) <= len(atoms)


def test_example_settings_file_is_valid():
    table = re.search(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert table
    assert RewardSettings(**tomllib.loads(table[1])["reward"]).goal == 10.0


@pytest.mark.parametrize("atoms", [3, 7, 9])
def test_lines_of_the_page_give_the_reward_to_the_bit(atoms: int):
    text = re.search(r"^```\n(format .*?)```", PAGE, re.MULTILINE | re.DOTALL)
    assert text
    names = tuple(f"apple_{index}" for index in range(atoms))
    goal = And(tuple(Atom("hot", (name,)) for name in names))
    task = Task("t", "s", "", TaskCategory.COMPOUND, goal, "", names)
    settings = RewardSettings(format=0.3, relevance_per_object=0.1, relevance_limit=0.7, goal=30.0)
    for count in range(atoms + 1):
        some = names[:count]
        found = score(task, frozenset(some), Holding([f"hot {name}" for name in some]), settings)
        known = {"settings": settings, "touched": count, "held": count, "atoms": atoms}
        exec(text[1], known)  # the page's own lines
        assert (found.format, found.relevance, found.goal, found.total) == tuple(
            known[name] for name in ("format", "relevance", "goal", "total")
        )
