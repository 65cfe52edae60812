"""Searches: tasks whose first look lacks something, found by a script that knows only what the robot has seen."""

import shutil
from dataclasses import replace

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.search import (
    SearchResult,
    evaluate_search,
    evaluation_of,
    search_tasks,
    searches,
)
from embomatrix.factory.pipeline.selection import write_selection
from embomatrix.scripts.searching import PlacePriors, SearchingScript, room_kind
from embomatrix.skills.prompt import PromptRow, Situation
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.skills.trace import Step
from embomatrix.world.dataset import Dataset, bundle_file
from embomatrix.world.state import Relation


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


@pytest.fixture(scope="module")
def results(kitchen):
    return search_tasks(kitchen, kitchen.records, kitchen, jobs=1)


def test_searches_hide_something_and_are_solved(kitchen, results):
    assert results.keys() == {record.task.task_id for record in kitchen.records}
    assert not results["apple_to_counter"].is_search
    assert all(result.found for result in results.values())
    chosen = searches(kitchen.records, results)
    assert 0 < len(chosen) < len(kitchen.records)


def test_command_writes_the_searches(kitchen, results, tmp_path):
    out = tmp_path / "selected"
    done = CliRunner().invoke(app, ["search", f"--dataset={kitchen.folder}", f"--out={out}", "--jobs=1"])
    assert done.exit_code == 0, done.output
    assert Dataset.load(out).records == tuple(searches(kitchen.records, results))


def test_figures_are_of_the_held_out_tasks(kitchen):
    found = evaluate_search(kitchen.folder, None, jobs=1, counter=lambda name, total: _Counter())
    oracle, blind = found.figure("search_oracle_success"), found.figure("search_blind_success")
    assert (oracle.value, oracle.n) == (1.0, len(kitchen.heldout))
    assert 0 <= blind.value <= 1


def test_only_the_success_of_searches_has_a_goal():
    easy, hidden, lost = SearchResult(0, True, 4), SearchResult(1, True, 9), SearchResult(2, False, 20)
    found = evaluation_of({"a": easy, "b": easy, "c": hidden, "d": lost}, {})
    every, of_searches = (
        found.figure(name) for name in ("search_oracle_success", "search_oracle_success of searches")
    )
    assert (every.value, every.n, every.goal) == (0.75, 4, None)
    assert (of_searches.value, of_searches.n, of_searches.goal) == (0.5, 2, 0.95)
    assert len(evaluation_of({"a": easy}, {}).figures) == 2, "nothing to search for"


def test_selection_replaces_all_files_of_an_older_one_and_keeps_transcripts(kitchen, tmp_path):
    source = Dataset.load(shutil.copytree(kitchen.folder, tmp_path / "source"))
    first, second = source.records[:2]
    for name, suffix in (("transcripts", "md"), ("trees", "json")):
        (source.folder / name).mkdir()
        for record in (first, second):
            (source.folder / name / f"{record.task.task_id}.{suffix}").write_text("{}")
    out = tmp_path / "out"
    write_selection(out, source, [first])
    (out / "bundles" / f"{'0' * 64}.bundle").touch()
    for name in ("build.jsonl", "attempts.jsonl", "times.jsonl", "merged.json", "notes.txt"):
        (out / name).touch()
    write_selection(out, source, [second])
    assert Dataset.load(out).records == (second,)
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()) == [
        f"bundles/{bundle_file(second.bundle_digest)}",
        "notes.txt",
        "tasks.jsonl",
        f"transcripts/{second.task.task_id}.md",
        f"trees/{second.task.task_id}.json",
    ]


class _Counter:
    def __enter__(self):
        return lambda done: None

    def __exit__(self, *_):
        pass


FRIDGE = PromptRow(0, "fridge_1", "fridge", "kitchen_0", states=("closed",), fixed=True)
CABINET = PromptRow(1, "cabinet_1", "cabinet", "kitchen_0", states=("closed",), fixed=True)
MILK = PromptRow(2, "milk_1", "milk", "kitchen_0", "fridge_1", Relation.INSIDE)
PLAN = (SkillCall(Skill.OPEN, object_index=0), SkillCall(Skill.PICK_UP, object_index=2))


def situation(*rows, room="kitchen_0", home=("kitchen_0",)):
    return Situation(home, room, rows, "Drink the milk.", 3, home=home)


def script(*known):
    return SearchingScript(PLAN, {0: "fridge", 2: "milk"}, PlacePriors(known))


def call(skill, index):
    return SkillCall(skill, object_index=index)


def done(which):
    return Step(which, None, "done")


def test_script_opens_first_what_usually_holds_the_thing():
    learned = script(situation(FRIDGE, CABINET, MILK))
    assert learned.next_call(situation(FRIDGE, CABINET), None) == call(Skill.MOVE, 0)
    assert learned.next_call(situation(FRIDGE, CABINET), done(call(Skill.MOVE, 0))) == call(Skill.OPEN, 0)


def test_script_closes_what_it_opened_in_vain_and_looks_elsewhere():
    learned = script(situation(FRIDGE, CABINET, MILK))
    empty = PromptRow(0, "fridge_1", "fridge", "kitchen_0", states=("open",), fixed=True)
    for _ in range(2):
        learned.next_call(situation(FRIDGE, CABINET), None)
    assert learned.next_call(situation(empty, CABINET), done(call(Skill.OPEN, 0))) == call(Skill.CLOSE, 0)
    assert learned.next_call(situation(FRIDGE, CABINET), done(call(Skill.CLOSE, 0))) == call(Skill.MOVE, 1)


def test_script_leaves_out_what_is_done_already():
    learned = script(situation(FRIDGE, CABINET, MILK))
    opened = PromptRow(0, "fridge_1", "fridge", "kitchen_0", states=("open",), fixed=True)
    assert learned.next_call(situation(opened, CABINET, MILK), None) == call(Skill.PICK_UP, 2)
    assert learned.next_call(situation(opened, CABINET, MILK), done(call(Skill.PICK_UP, 2))) is None


def test_script_goes_to_the_room_that_usually_has_the_thing():
    home = ("bedroom_0", "hall_0", "kitchen_0")
    learned = script(situation(FRIDGE, MILK))
    at_start = situation(FRIDGE, room="hall_0", home=home)
    seen = PromptRow(0, "fridge_1", "fridge", "kitchen_0", states=("open",), fixed=True)
    assert learned.next_call(at_start, None) == SkillCall(Skill.GO_TO_ROOM, room_name="kitchen_0")
    assert learned.next_call(situation(seen, room="kitchen_0", home=home), None) == SkillCall(
        Skill.GO_TO_ROOM, room_name="bedroom_0"
    )


def test_script_moves_and_repeats_a_call_that_failed_once():
    learned = script()
    everything = situation(FRIDGE, CABINET, MILK)
    assert learned.next_call(everything, None) == call(Skill.OPEN, 0)
    failed = Step(call(Skill.OPEN, 0), "out_of_reach", "too far")
    assert learned.next_call(everything, failed) == call(Skill.MOVE, 0)
    assert learned.next_call(everything, done(call(Skill.MOVE, 0))) == call(Skill.OPEN, 0)


def test_script_that_takes_over_looks_nowhere_again_unless_it_is_closed():
    home = ("bedroom_0", "hall_0", "kitchen_0")
    to_bedroom = SkillCall(Skill.GO_TO_ROOM, room_name="bedroom_0")
    opened = PromptRow(1, "cabinet_1", "cabinet", "kitchen_0", states=("open",), fixed=True)
    known = situation(FRIDGE, opened, room="kitchen_0", home=home)
    refused = Step(SkillCall(Skill.GO_TO_ROOM, room_name="hall_0"), "no_path", "there is no way")
    before = [done(to_bedroom), done(call(Skill.MOVE, 0)), done(call(Skill.OPEN, 1)), refused]
    learned = script()
    learned.take_over(known, before)
    asked = []
    while (found := learned.next_call(known, None)) is not None:
        asked.append(found)
    rooms = {each.room_name for each in asked if each.skill is Skill.GO_TO_ROOM}
    assert rooms == {"hall_0"}  # neither the bedroom, where it was, nor the kitchen, where it is
    assert call(Skill.OPEN, 0) in asked
    assert call(Skill.MOVE, 1) not in asked


def test_script_with_a_full_hand_places_what_is_in_it_before_it_opens_anything():
    cup = PromptRow(3, "cup_1", "cup", "kitchen_0")
    table = PromptRow(4, "table_1", "table", "kitchen_0", fixed=True)
    put = SkillCall(Skill.PLACE, object_index=4, relation=PlaceRelation.ONTOP)
    plan = (call(Skill.MOVE, 4), put, *PLAN)
    rows = {0: "fridge", 2: "milk", 4: "table"}
    seen = replace(situation(FRIDGE, CABINET, cup, table), held=("cup_1",))
    learned = SearchingScript(plan, rows, PlacePriors())
    learned.take_over(seen, [])
    assert [learned.next_call(seen, None) for _ in range(2)] == [call(Skill.MOVE, 4), put]
    emptied = replace(seen, held=())
    assert learned.next_call(emptied, done(put)).skill in (Skill.MOVE, Skill.OPEN)
    # Where the place is unseen, it looks for that, but not into what it could not open.
    far = replace(situation(FRIDGE, CABINET, cup, home=("den_0", "kitchen_0")), held=("cup_1",))
    searching = SearchingScript(plan, rows, PlacePriors())
    asked = []
    while (found := searching.next_call(far, None)) is not None:
        asked.append(found)
    assert SkillCall(Skill.GO_TO_ROOM, room_name="den_0") in asked
    assert all(each.skill is not Skill.OPEN for each in asked)


def test_script_gives_up_when_nowhere_is_left():
    learned = script()
    assert learned.next_call(situation(), None) is None
    assert room_kind("living_room_0") == "living_room"
