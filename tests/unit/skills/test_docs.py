"""docs/skills.md agrees with the code: its tables match the library, and its plans parse."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from embomatrix.sim.geometry import surfaces as spots
from embomatrix.sim.state import relations, sources
from embomatrix.skills.check import RULES
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY, Precondition
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.parse import MAX_ROOM_NAME, PlanReason, parse_plan, plan_from_json
from embomatrix.skills.syntax import MAX_PLAN_BYTES, MAX_STEPS, SIGNATURES, Arg, Skill
from embomatrix.world import state
from embomatrix.world.state import Relation, State, SubstanceRelation
from embomatrix.world.substances import MEANINGS
from embomatrix.world.task import Profile

PAGE = (Path(__file__).parents[3] / "docs" / "skills.md").read_text(encoding="utf-8")


def fences(language: str) -> list[str]:
    """Return the contents of the page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def rows(first_heading: str) -> dict[str, list[str]]:
    """Return the table whose first column has this heading: row names mapped to the other cells, without code marks."""
    found = re.search(rf"^\| {first_heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/skills.md has no table of {first_heading}"
    cells = [
        [cell.strip().replace("`", "") for cell in line.strip("|").split(" | ")]
        for line in found[1].splitlines()
    ]
    return {name: rest for name, *rest in cells}


def listed(cell: str) -> list[str]:
    return [] if cell == "–" else cell.split(", ")


def test_table_lists_every_skill_with_arguments_preconditions_effect_and_outcomes():
    assert rows("skill") == {
        skill.value: [
            ", ".join(SIGNATURES[skill]),
            ", ".join(item.name.lower() for item in LIBRARY[skill].preconditions) or "–",
            LIBRARY[skill].effect,
            ", ".join(LIBRARY[skill].outcomes) or "–",
        ]
        for skill in Skill
    }


def test_table_lists_every_argument():
    assert list(rows("argument")) == [*Arg]
    assert f"at most {MAX_ROOM_NAME} characters" in rows("argument")[Arg.ROOM][0]


def test_table_lists_every_precondition_with_its_text_and_reasons():
    assert {name: (asks, listed(reasons)) for name, (asks, reasons) in rows("condition").items()} == {
        item.name.lower(): (item.value, [*RULES[item].reasons]) for item in Precondition
    }


def test_table_lists_every_failure_reason_with_its_sentence():
    table = re.search(r"### Reasons of failure\n\n(.*?)\n\n", PAGE, re.DOTALL)
    assert table
    written = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", table[1], re.MULTILINE))
    assert written == {reason.value: reason.sentence for reason in FailureReason}


def test_table_lists_every_plan_error():
    said = rows("reason")
    assert set(said) == set(PlanReason)
    assert f"{MAX_PLAN_BYTES:,} bytes" in said[PlanReason.TOO_LONG][0]
    assert f"{MAX_STEPS} calls" in said[PlanReason.TOO_MANY_STEPS][0]


def test_table_lists_every_robot_limit_with_its_value():
    assert {name: float(value) for name, (value, _) in rows("limit").items()} == dataclasses.asdict(ROBOT)


def test_tables_list_every_relation_and_state():
    assert set(rows("relation")) == set(Relation)
    assert set(rows("state")) == set(State)


def test_tables_list_every_profile_and_substance_relation():
    assert set(rows("profile")) == set(Profile)
    assert set(rows("fact")) == set(SubstanceRelation)
    for word, fact in MEANINGS.items():
        assert rows("state")[word] == [f"another word for {fact.relation} with {fact.substance}"]


def test_table_lists_every_relation_tolerance_with_its_value():
    tolerances = {
        name: value
        for name, value in {**vars(spots), **vars(relations)}.items()
        if name.isupper() and isinstance(value, float) and name not in vars(state)
    }
    written = {name: float(value) for name, (value, _) in rows("tolerance").items()}
    assert written == pytest.approx(tolerances, rel=1e-3)


def test_table_lists_every_state_threshold_with_its_value():
    known = {**vars(state), **vars(sources)}
    written = {name: float(value) for name, (value, _) in rows("constant").items()}
    assert written == {name: known[name] for name in written}
    assert {"HOT_C", "COOK_C", "FREEZE_C", "OPEN_FRACTION"} <= set(written)


def test_json_plan_on_the_page_parses_completely():
    (text,) = fences("json")
    assert parse_plan(text) == plan_from_json(json.loads(text))


def test_line_plan_on_the_page_parses_completely():
    (text,) = fences("plan")
    assert len(parse_plan(text)) == len(re.split(r"[;\n]", text.strip()))
