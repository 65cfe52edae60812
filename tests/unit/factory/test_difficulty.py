"""Selections of tasks by difficulty, and shares of a small policy from a report."""

import json
from collections import Counter
from dataclasses import replace

import pytest
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.factory.evaluate.difficulty import (
    level_counts,
    read_policy_shares,
    selected,
    shares_of,
    with_policy,
    with_scripts,
)
from embomatrix.factory.evaluate.scripts import ScriptName
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.difficulty import DifficultyLevel

EASY = dict.fromkeys(ScriptName, True)
MEDIUM = {ScriptName.TEMPLATE: True, ScriptName.NEAREST: False, ScriptName.GREEDY: False}
HARD = dict.fromkeys(ScriptName, False)
CALL = {"action": "move", "object_index": 1}


def records(split, easy, medium, hard):
    """Return measured records of one split, in turns through the levels."""
    task = kitchen_tasks(kitchen_scene())[0]
    results = [EASY] * easy + [MEDIUM] * medium + [HARD] * hard
    found = [
        TaskRecord(
            task=replace(task, task_id=f"{split}-{number}"),
            bundle_digest="sha256:" + "0" * 64,
            split=split,
            oracle=(CALL, CALL),
            rooms=("kitchen_0",),
            signature="",
        )
        for number in range(len(results))
    ]
    return with_scripts(
        found, {record.task.task_id: result for record, result in zip(found, results, strict=True)}
    )


def levels(chosen, split="train"):
    return level_counts(chosen)[split]


def test_scripts_and_oracle_give_the_difficulty() -> None:
    difficulty = records("train", 0, 1, 0)[0].difficulty
    assert difficulty is not None
    assert (difficulty.template, difficulty.nearest, difficulty.greedy, difficulty.steps) == (
        True,
        False,
        False,
        2,
    )


def test_task_without_a_result_stays_as_it_is() -> None:
    measured = records("train", 1, 0, 0)
    assert with_scripts(measured, {}) == measured


def test_selection_has_the_wanted_shares_and_is_as_large_as_they_allow() -> None:
    chosen = selected(records("train", 60, 25, 15), shares_of(0.4, 0.3))
    assert levels(chosen) == {DifficultyLevel.EASY: 20, DifficultyLevel.MEDIUM: 15, DifficultyLevel.HARD: 15}


def test_selection_keeps_the_order_and_depends_on_the_ids_only() -> None:
    every = records("train", 30, 10, 10)
    chosen = selected(every, shares_of(0.5, 0.25))
    assert [record for record in every if record in chosen] == chosen
    assert selected(every[::-1], shares_of(0.5, 0.25)) == chosen[::-1]


def test_each_split_is_selected_by_itself() -> None:
    every = [*records("train", 8, 8, 0), *records("heldout", 2, 6, 0)]
    chosen = selected(every, shares_of(0.5, None))
    assert sum(levels(chosen).values()) == 16
    assert levels(chosen, "heldout") == Counter({DifficultyLevel.EASY: 2, DifficultyLevel.MEDIUM: 2})


def test_other_split_is_kept_whole() -> None:
    every = [*records("train", 8, 8, 8), *records("heldout", 2, 6, 0)]
    chosen = selected(every, shares_of(None, 1.0), ("train",))
    assert levels(chosen) == {DifficultyLevel.HARD: 8}
    assert sum(levels(chosen, "heldout").values()) == 8


def test_split_without_a_wanted_level_is_reported() -> None:
    with pytest.raises(EvaluationError, match=r"the split train has no hard task, and 50% of the selection"):
        selected(records("train", 5, 5, 0), shares_of(None, 0.5))


def test_shares_above_one_are_reported() -> None:
    with pytest.raises(EvaluationError, match=r"add up to 1.3: expected at most 1"):
        shares_of(0.7, 0.6)


def test_policy_shares_come_from_a_report_without_lost_plans(tmp_path) -> None:
    samples = [{"success": True}, {"success": False}, {"success": False, "lost": True}]
    lost = [{"success": False, "lost": True}]
    path = tmp_path / "report.json"
    path.write_text(
        json.dumps(
            {"verdicts": [{"task": "train-0", "samples": samples}, {"task": "train-1", "samples": lost}]}
        )
    )
    shares = read_policy_shares(path)
    assert shares == {"train-0": 0.5}
    first, second = with_policy(records("train", 2, 0, 0), shares)
    assert first.difficulty is not None
    assert second.difficulty is not None
    assert (first.difficulty.small_policy, second.difficulty.small_policy) == (0.5, None)


def test_measuring_again_keeps_the_share_of_the_policy() -> None:
    policy = with_policy(records("train", 1, 0, 0), {"train-0": 0.75})
    again = with_scripts(policy, {"train-0": HARD})[0].difficulty
    assert again is not None
    assert (again.level, again.small_policy) == (DifficultyLevel.HARD, 0.75)


@pytest.mark.parametrize("text", ["", "[]", '{"verdicts": [{"task": "x"}]}', '{"verdicts": [1]}'])
def test_other_file_than_a_report_is_refused(tmp_path, text) -> None:
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(EvaluationError, match=r"expected the report.json that `embomatrix eval` wrote"):
        read_policy_shares(tmp_path / "report.json")
