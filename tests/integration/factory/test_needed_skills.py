"""Skills that tasks need: the oracle's plan fails without them."""

import contextlib
import re
from dataclasses import replace
from pathlib import Path

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.plans import plan_of, task_over
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.faithfulness import PolicyAnswers, audit_dataset
from embomatrix.factory.evaluate.skills import (
    UNNEEDED,
    NeededSkills,
    evaluate_skills,
    needed_in_dataset,
    needed_skills,
)
from embomatrix.factory.evaluate.verification import Judgement, verify_again
from embomatrix.factory.metrics.figures import EvaluationError, read_evaluation
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import PlaceRelation, Skill
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.goal import And, Atom
from embomatrix.world.task import Profile

DOCS = Path(__file__).parents[3] / "docs" / "skills.md"
PICK, PLACE, NEXT = Skill.PICK_UP, Skill.PLACE, PlaceRelation.NEXTTO


@pytest.fixture
def play(kitchen):
    with contextlib.closing(load_simulator(Bundle(kitchen, {}))) as simulator:

        def needs(goal, text):
            task = task_over(kitchen, goal)
            return needed_skills(simulator, task, plan_of(task, text))

        yield needs


@pytest.fixture(scope="module")
def kitchen():
    from tests.fakes.scenes import kitchen_scene

    return kitchen_scene()


def test_skill_is_needed_if_the_goal_is_missed_without_its_calls(play):
    goal = And((Atom("nextto", ("apple_1", "bowl_1")), Atom("toggled_on", ("stove_1",))))
    found = play(
        goal,
        "go_to_room living_room_0; turn 1; move stove_1; toggle_on stove_1; toggle_off sink_1; move apple_1; "
        "pick_up apple_1; move bowl_1; place bowl_1 nextto",
    )
    assert not found.proved
    found = play(
        goal,
        "go_to_room kitchen_0; turn 1; move stove_1; toggle_on stove_1; move apple_1; pick_up apple_1; "
        "move bowl_1; place bowl_1 nextto",
    )
    assert found.proved
    assert found.skills == {Skill.MOVE, Skill.TOGGLE_ON, PICK, PLACE}
    assert found.relations == {NEXT}


def test_waiting_at_a_running_source_is_not_needed(play):
    found = play(
        Atom("hot", ("apple_1",)),
        "move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop; toggle_on stove_1; "
        "heat_object_with_source apple_1 stove_1",
    )
    assert found.proved
    assert Skill.HEAT not in found.skills


def needs(task, *skills, relations=(), proved=True):
    return NeededSkills(task, Profile.PAPER, proved, frozenset(skills), frozenset(relations))


def test_smallest_share_is_over_the_skills_that_goals_can_need():
    every = frozenset(Skill) - UNNEEDED.keys() - {Skill.SLICE, Skill.CLEAN, Skill.SOAK}
    tasks = [needs("a", *every, relations=[NEXT]), needs("b", *every - {Skill.CLOSE}), needs("c", Skill.OPEN)]
    found = evaluate_skills(Path("some"), tasks)
    assert found.figure("skill_share_min").value == pytest.approx(1 / 3)
    assert found.figure("skill_share open").value == 1.0
    assert found.figure("skill_share close").value == pytest.approx(1 / 3)
    assert found.figure("skill_share place nextto").value == pytest.approx(1 / 3)
    assert "skill_share turn" not in {figure.name for figure in found.figures}
    assert "skill_share clean_object_with_tool" not in {figure.name for figure in found.figures}


def test_failing_plans_are_counted_in_a_note():
    found = evaluate_skills(Path("some"), [needs("a", Skill.TURN), needs("b", proved=False)])
    assert "Needed all the same: turn." in found.notes
    assert any(note.startswith("1 of 2 oracle plans do not reach their goal") for note in found.notes)


def test_dataset_without_tasks_is_reported_in_a_sentence():
    with pytest.raises(EvaluationError, match="some has no tasks"):
        evaluate_skills(Path("some"), [])


def test_docs_list_every_skill_that_no_goal_needs_with_its_reason():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE))
    assert {skill: rows.get(skill) for skill in UNNEEDED} == dict(UNNEEDED)


@pytest.mark.parametrize(
    "measure",
    [
        lambda folder, records: needed_in_dataset(folder, records, 1),
        lambda folder, records: audit_dataset(folder, records, plans=1, answers=PolicyAnswers(), jobs=1),
        lambda folder, records: verify_again(folder, records, physical=False, jobs=1),
    ],
)
def test_records_are_not_read_again_and_unreadable_plans_are_named(tmp_path, measure):
    dataset = Dataset.load(write_kitchen_dataset(tmp_path))
    (tmp_path / "tasks.jsonl").write_text("damaged")
    assert len(measure(tmp_path, dataset.records[:1])) == 1
    if measure(tmp_path, dataset.records[:1])[0].__class__ is Judgement:
        return  # it executes no stored plan
    broken = replace(dataset.records[0], oracle=({"skill": "juggle"},))
    with pytest.raises(DatasetError, match=r"the oracle plan of task .* can't be read"):
        measure(tmp_path, [broken])


def test_command_measures_a_dataset(tmp_path):
    write_kitchen_dataset(tmp_path / "kitchen")
    arguments = ["evaluate", "skills", "--dataset", str(tmp_path / "kitchen"), "--out", str(tmp_path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    figure = read_evaluation(tmp_path / "skills.json").figure("skill_share move")
    assert 0 < figure.value <= 1
