"""Scene evaluation: every flaw is detected, valid scenes have none, and rates are correct."""

import contextlib
import json
from dataclasses import replace
from importlib import resources
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.admission import MAX_HELD_SHARE
from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.evaluate import scenes
from embomatrix.factory.evaluate.scene_geometry import Flaw, flaws_of
from embomatrix.factory.evaluate.scenes import (
    LIST,
    LayoutMethod,
    LayoutOutcome,
    PoseSource,
    RecordedMethod,
    evaluate_scenes,
    evaluation_of,
    fixed_tasks,
    interval_of_mean,
    outcome_log,
    task_list_settings,
)
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.request import RequestedObject
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.task_import.batch import max_held_share
from embomatrix.factory.task_import.sources import SourceText, read_activity
from embomatrix.factory.task_import.task import ImportOptions, import_problem
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import DatasetError
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import PoseCache
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.world.scene import Scene


def test_seventy_tasks_of_each_source_are_fixed_in_known_scenes() -> None:
    text = (resources.files("embomatrix.factory.evaluate") / LIST).read_text(encoding="utf-8")
    names = json.loads(text)
    assert [len(names["sample"]), len(names["behavior"])] == [70, 70]
    for source in names.values():
        assert len({name for name, _ in source}) == 70
        assert {scene for _, scene in source} <= set(Catalog.load().scene_ids)


def test_sample_without_the_fixed_tasks_is_rejected(tmp_path: "Path") -> None:
    file = tmp_path / "sample.jsonl"
    file.write_text('{"name": "other", "bddl": "()"}\n', encoding="utf-8")
    with pytest.raises(EvaluationError, match="lacks 70 of the fixed tasks"):
        fixed_tasks(file)


def test_generated_layouts_have_no_flaw(flat: "Scene") -> None:
    editor = SceneEditor(flat)
    layout = lay(editor, [RequestedObject("mug", (("mug", Catalog.load().models_of("mug")[0].model_id),))], 0)
    assert flaws_of(editor.freeze("sound"), tuple(layout.names.values())) == ()


def placed(flat: "Scene", x: float, y: float, low_m: float, host: str = "") -> set[Flaw]:
    """Return the flaws of a basket at a place chosen without any check."""
    editor = SceneEditor(flat)
    asset = build_asset(
        Catalog.load(), "wicker_basket", Catalog.load().models_of("wicker_basket")[0].model_id
    )
    room = next(room.name for room in flat.rooms if room.name == "living_room_0")
    relation = Relation.ONTOP if host else None
    name = editor.insert(asset, Pose((x, y, low_m + asset.size_m[2] / 2)), relation, host, room)
    return {flaw for found, flaw in flaws_of(editor.freeze("odd"), (name,)) if found == name}


def test_each_flaw_of_an_object_is_detected(flat: "Scene") -> None:
    room = next(room for room in flat.rooms if room.name == "living_room_0")
    table = next(
        item for item in flat.objects if item.name.startswith("breakfast_table") and item.room == room.name
    )
    x, y, middle = table.pose_world_asset.position_m
    top = middle + flat.asset_of(table.name).size_m[2] / 2
    door = next(door for door in flat.doorways if room.name in door.rooms)
    assert Flaw.PENETRATES in placed(flat, x, y, top - 0.02)
    assert Flaw.FLOATS in placed(flat, x, y, top + 0.3)
    assert Flaw.OUTSIDE in placed(flat, room.low_m[0], y, 0.001)
    assert Flaw.BARS_DOORWAY in placed(flat, *door.center_m, 0.001)
    assert Flaw.UNREACHED in placed(flat, x, y, 2.1)


def outcome(
    method: LayoutMethod, reason: str = "", *, generated: bool = True, verified: bool = True
) -> LayoutOutcome:
    return LayoutOutcome("task", "Rs_int", method, generated, verified, verified, reason, 1.0, (0.01,), 8.0)


def test_rates_are_shares_and_only_the_tree_method_has_goals() -> None:
    found = [
        outcome(LayoutMethod.TREE),
        outcome(LayoutMethod.TREE, "geometry", verified=False),
        outcome(LayoutMethod.TREE, "does_not_fit", generated=False, verified=False),
        outcome(LayoutMethod.RANDOM),
    ]
    evaluation = evaluation_of(found, {})
    assert evaluation.figure("generation_rate").value == pytest.approx(200 / 3)
    assert evaluation.figure("verification_pass_rate").value == 50.0
    assert evaluation.figure("verification_pass_rate").goal == 99.0
    assert evaluation.figure("generation_rate random").goal is None
    assert "does_not_fit 1" in evaluation.notes[0]


def test_aesthetics_are_compared_over_the_tasks_that_every_method_laid_out() -> None:
    crowded = replace(outcome(LayoutMethod.TREE), task="crowded", aesthetics=6.0)
    failed = replace(
        outcome(LayoutMethod.RANDOM, "does_not_fit", generated=False), task="crowded", aesthetics=None
    )
    found = evaluation_of([outcome(LayoutMethod.TREE), outcome(LayoutMethod.RANDOM), crowded, failed], {})
    assert found.figure("aesthetics").value == 7.0
    assert found.figure("aesthetics_shared").value == 8.0
    assert found.figure("aesthetics_shared random").n == 1
    assert "aesthetics_shared" not in {each.name for each in evaluation_of([crowded], {}).figures}


KNOWN = [
    LayoutOutcome("known", "Rs_int", method, True, True, True, "", 1.0, (0.01, 0.02), 8.0)
    for method in LayoutMethod
]
UNICORN = """(define (problem unicorn)
    (:domain omnigibson)
    (:objects unicorn.n.01_1 - unicorn.n.01 floor.n.01_1 - floor.n.01)
    (:init (inroom floor.n.01_1 kitchen) (ontop unicorn.n.01_1 floor.n.01_1))
    (:goal (not (ontop unicorn.n.01_1 floor.n.01_1)))
)"""


def test_resumed_run_makes_only_the_missing_trials(tmp_path: "Path") -> None:
    path = tmp_path / "outcomes.jsonl"
    log = outcome_log(path, 0)
    for outcome in KNOWN:
        log.add(outcome)
    tasks = [SourceText(name, UNICORN, "embomatrix", scene="Rs_int") for name in ("known", "new")]
    counts: list[int] = []
    _, outcomes = evaluate_scenes(tasks, list(LayoutMethod), 0, 1, counts.append, outcome_log(path, 0))
    assert outcomes[:3] == KNOWN
    assert [(each.task, each.method) for each in outcomes[3:]] == [("new", method) for method in LayoutMethod]
    assert all("unicorn" in each.detail for each in outcomes[3:])
    assert counts == [3, 4, 5, 6]
    assert outcome_log(path, 0).outcomes == outcomes


def test_truncated_last_line_is_repeated(tmp_path: "Path") -> None:
    path = tmp_path / "outcomes.jsonl"
    log = outcome_log(path, 0)
    for outcome in KNOWN[:2]:
        log.add(outcome)
    whole = path.read_text(encoding="utf-8")
    path.write_text(whole[:-30], encoding="utf-8")
    taken_up = outcome_log(path, 0)
    assert taken_up.outcomes == KNOWN[:1]
    taken_up.add(KNOWN[1])
    assert path.read_text(encoding="utf-8") == whole


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"seed": 1}\n', "other settings \\(seed 1, now 0\\): give the same"),
        ("", "is damaged: expected the settings"),
        ('{"seed": 0}\n{"task": 3}\n{}\n', ":2 is not an outcome"),
    ],
)
def test_outcomes_of_another_seed_are_rejected(tmp_path: "Path", content: str, message: str) -> None:
    path = tmp_path / "outcomes.jsonl"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(DatasetError, match=message):
        outcome_log(path, 0)
    assert path.read_text(encoding="utf-8") == content


ANSWER = {
    "question": "q",
    "number": 0,
    "text": "",
    "prompt_tokens": 0,
    "completion_tokens": 0,
    "finish": "stop",
}


def test_a_log_belongs_to_one_source_of_poses_and_one_list_of_tasks(tmp_path: "Path") -> None:
    one, other = tmp_path / "one.jsonl", tmp_path / "other.jsonl"
    for path, model in ((one, "small-1"), (other, "small-2")):
        path.write_text(json.dumps({**ANSWER, "model": model}) + "\n", encoding="utf-8")
    known = PoseSource(one).settings()
    assert known["pose model"] == "small-1"
    tasks = [SourceText(name, UNICORN, "embomatrix", scene="Rs_int") for name in ("known", "new")]
    log = tmp_path / "outcomes.jsonl"
    outcome_log(log, 0, {**task_list_settings(tasks), **known})
    outcome_log(log, 0, {**task_list_settings(tasks), **PoseSource(one).settings()})
    with pytest.raises(
        DatasetError, match="other settings \\(pose model small-1, now small-2, pose recording"
    ):
        outcome_log(log, 0, {**task_list_settings(tasks), **PoseSource(other).settings()})
    with pytest.raises(DatasetError, match="other settings \\(task list sha256:"):
        outcome_log(log, 0, {**task_list_settings(tasks[:1]), **known})
    growing = PoseSource(one, "http://127.0.0.1:1", "small-3").settings()
    assert growing == {"pose model": "small-3", "pose recording": "one.jsonl"}
    assert "SmolLM2" in PoseSource().settings()["pose model"]


def test_conditions_name_the_tasks_and_the_model_of_the_poses() -> None:
    tasks = [SourceText("new", UNICORN, "embomatrix", scene="Rs_int")]
    evaluation, _ = evaluate_scenes(tasks, [LayoutMethod.TREE], 0, 1)
    assert evaluation.conditions.items() >= {**task_list_settings(tasks), **PoseSource().settings()}.items()


@pytest.mark.parametrize("source", ["behavior-1k", "embomatrix"])
def test_oracle_is_held_to_the_same_limit_as_an_import(source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = []
    monkeypatch.setattr(scenes, "SceneView", lambda _: None)
    monkeypatch.setattr(scenes, "poses_for", lambda *_: PoseCache())
    monkeypatch.setattr(scenes, "load_simulator", lambda _: contextlib.nullcontext())
    monkeypatch.setattr(scenes.contextlib, "closing", lambda each: each)
    monkeypatch.setattr(scenes, "out_of_hand", lambda *_: ())
    monkeypatch.setattr(scenes, "admit", lambda *_, most_held: limits.append(most_held))
    task = SimpleNamespace(source=source)
    scenes._executed(SimpleNamespace(scene=None, task=task, init=(), about=()), None, 0)
    assert limits == [max_held_share(task)]
    assert limits == [1.0 if source == "behavior-1k" else MAX_HELD_SHARE]


def test_packaged_recording_has_every_pose_of_a_fixed_task() -> None:
    text = (resources.files("embomatrix.factory.evaluate") / LIST).read_text(encoding="utf-8")
    scene = dict(json.loads(text)["behavior"])["store_firewood"]
    with PoseSource().methods() as methods:
        laid = RecordedMethod(methods[LayoutMethod.POSES])
        task = read_activity("store_firewood")
        import_problem(task, build_base_scene(scene), seed=0, options=ImportOptions(lay=laid))
    assert laid.unwritten == 0
    assert len(laid.names) >= 3


def test_interval_of_a_mean_holds_it_and_narrows_with_more_scores() -> None:
    few, many = interval_of_mean([6.0, 8.0] * 5), interval_of_mean([6.0, 8.0] * 50)
    assert few[0] < many[0] < 7.0 < many[1] < few[1]
