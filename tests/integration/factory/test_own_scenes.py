"""Scenes of files take the place of base scenes: tasks are built and imported in them, and datasets hold them."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.floorplan.house_file import read_house
from embomatrix.factory.pipeline.build import build_dataset
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.scenes.base_scenes import SCENES_FOLDER, BaseScenes, base_scenes
from embomatrix.factory.scenes.build import build_base_scene, build_house
from embomatrix.factory.scenes.scene_file import SceneFileError, read_scene, write_scene
from embomatrix.reward.hierarchy import score
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.asset import Credit
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, TaskRecord
from embomatrix.world.scene import Scene

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "two_bedroom_flat.toml"
CREDIT = Credit("A. Maker", "CC0-1.0", "https://example.org")
QUICK = ("--no-reachability", "--jobs", "1")
APPLE = """(define (problem Put_the_apple_in_the_fridge) (:domain omnigibson)
  (:objects apple.n.01_1 - apple.n.01 electric_refrigerator.n.01_1 - electric_refrigerator.n.01
            breakfast_table.n.01_1 - breakfast_table.n.01)
  (:init (inroom electric_refrigerator.n.01_1 kitchen) (inroom breakfast_table.n.01_1 kitchen)
         (ontop apple.n.01_1 breakfast_table.n.01_1))
  (:goal (inside ?apple.n.01_1 ?electric_refrigerator.n.01_1)))
"""


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    return result.exit_code, result.output + result.stderr


@pytest.fixture(scope="module")
def house() -> Scene:
    """Return the flat of the documentation with an imported fridge."""
    plain = build_house(read_house(EXAMPLE), seed=7)
    fridge = plain.asset_of("fridge_1")
    imported = {fridge.asset_id: replace(fridge, credit=CREDIT)}
    return build_house(read_house(EXAMPLE), seed=7, imported=imported)


@pytest.fixture(scope="module")
def file(house: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "flat_of_mine.json"
    write_scene(path, house)
    return path


@pytest.fixture(scope="module")
def built(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of eight tasks in the file's scene, built by the command."""
    folder = tmp_path_factory.mktemp("built") / "dataset"
    code, output = run("build", "--out", folder, "--train", 8, "--heldout", 0, "--scenes", file, *QUICK)
    assert code == 0, output
    return folder


def assert_solved(dataset: Dataset, record: TaskRecord) -> None:
    """Execute the oracle's plan in the bundle of the dataset."""
    bundle = dataset.bundle(record.bundle_digest)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        plan = plan_from_json(list(record.oracle), record.task.profile)
        trace = simulator.execute(record.task, plan, seed=0)
        assert score(record.task, trace.touched, simulator.facts).success


def test_dataset_of_a_scene_file_is_complete_elsewhere(built: Path, house: Scene, tmp_path: Path) -> None:
    moved = Dataset.load(shutil.copytree(built, tmp_path / "elsewhere"))
    assert len(moved.records) == 8
    for record in moved.records:
        scene = moved.bundle(record.bundle_digest).scene
        assert record.task.scene_id.startswith("two_bedroom_flat-train-")
        assert (scene.base, scene.rooms, scene.walls) == (house.base, house.rooms, house.walls)
        assert scene.asset_of("fridge_1").credit == CREDIT
    assert_solved(moved, moved.records[0])
    assert read_scene(tmp_path / "elsewhere" / SCENES_FOLDER / "two_bedroom_flat.json") == house


def test_file_of_a_base_scene_gives_the_tasks_of_its_name(tmp_path: Path) -> None:
    base = build_base_scene("Benevolence_1_int")
    settings = BuildSettings(2, 0, scenes=(base.base,), reachability=False, physical=False)
    build_dataset(tmp_path / "named", settings)
    build_dataset(tmp_path / "file", settings, own={base.base: base})
    named, of_file = (tmp_path / name / TASKS_FILE for name in ("named", "file"))
    assert named.read_bytes() == of_file.read_bytes()
    assert not (tmp_path / "named" / SCENES_FOLDER).exists()


def test_another_seed_of_a_base_scene_gives_other_tasks(tmp_path: Path) -> None:
    base = build_base_scene("Benevolence_1_int", seed=3)
    write_scene(tmp_path / "third.json", base)
    chosen = base_scenes([str(tmp_path / "third.json")])
    assert chosen.names == ("Benevolence_1_int",)
    assert chosen.built_all(seed=0) == [base]


def test_processes_get_the_scene_of_the_file(built: Path, file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "two"
    line = ("build", "--out", folder, "--train", 8, "--heldout", 0, "--scenes", file)
    code, output = run(*line, "--no-reachability", "--jobs", 2)
    assert code == 0, output
    assert (folder / TASKS_FILE).read_bytes() == (built / TASKS_FILE).read_bytes()


def test_build_resumes_with_the_same_file_only(built: Path, file: Path, house: Scene, tmp_path: Path) -> None:
    folder = shutil.copytree(built, tmp_path / "dataset")
    (folder / TASKS_FILE).unlink()
    other = replace(house, seed=8)
    write_scene(tmp_path / "other.json", other)
    line = ("build", "--out", folder, "--train", 8, "--heldout", 0, *QUICK)
    code, output = run(*line, "--scenes", tmp_path / "other.json")
    assert code == 2
    assert "holds a build with another scene 'two_bedroom_flat'" in output
    code, output = run(*line, "--scenes", "two_bedroom_flat")
    assert code == 2
    assert "unknown scene 'two_bedroom_flat'" in output
    assert not (folder / TASKS_FILE).exists()
    code, output = run(*line, "--scenes", file)
    assert code == 0, output
    assert (folder / TASKS_FILE).read_bytes() == (built / TASKS_FILE).read_bytes()


def test_name_and_file_of_one_scene_do_not_resume_each_other(tmp_path: Path) -> None:
    base = build_base_scene("Benevolence_1_int")
    settings = BuildSettings(0, 0, scenes=(base.base,), reachability=False, physical=False)
    build_dataset(tmp_path / "named", settings)
    with pytest.raises(DatasetError, match="of the catalog, not of a file"):
        build_dataset(tmp_path / "named", settings, own={base.base: base})
    build_dataset(tmp_path / "file", settings, own={base.base: base})
    with pytest.raises(DatasetError, match=r"give that file with --scenes"):
        build_dataset(tmp_path / "file", settings)


def test_problem_is_imported_into_a_scene_file(file: Path, house: Scene, tmp_path: Path) -> None:
    (tmp_path / "apple.bddl").write_text(APPLE, encoding="utf-8")
    line = ("import", "--bddl", tmp_path / "apple.bddl", "--scenes", file, *QUICK)
    code, output = run(*line, "--out", tmp_path / "mine", "--report", tmp_path / "report.json")
    assert code == 0, output
    dataset = Dataset.load(tmp_path / "mine")
    (record,) = dataset.records
    assert record.task.scene_id.startswith("two_bedroom_flat-")
    assert dataset.bundle(record.bundle_digest).scene.asset_of("fridge_1").credit == CREDIT
    assert read_scene(tmp_path / "mine" / SCENES_FOLDER / "two_bedroom_flat.json") == house
    assert '"has_right_scene": true' in (tmp_path / "report.json").read_text()


def test_outcomes_of_one_scene_file_are_not_resumed_with_another(
    file: Path, house: Scene, tmp_path: Path
) -> None:
    (tmp_path / "apple.bddl").write_text(APPLE, encoding="utf-8")
    write_scene(tmp_path / "other.json", replace(house, seed=8))
    line = (
        "import",
        "--bddl",
        tmp_path / "apple.bddl",
        "--bind-only",
        "--outcomes",
        tmp_path / "log",
        *QUICK,
    )
    code, output = run(*line, "--scenes", file)
    assert code == 0, output
    code, output = run(*line, "--scenes", tmp_path / "other.json")
    assert code == 2
    assert "holds a run with other settings" in output


def test_layout_agents_work_in_a_scene_file(file: Path, tmp_path: Path) -> None:
    (tmp_path / "apple.bddl").write_text(APPLE, encoding="utf-8")
    code, output = run("lay", "--scene", file, "--bddl", tmp_path / "apple.bddl")
    assert code == 0, output
    assert "apple.n.01_1" in output


def test_scenes_that_cannot_stand_for_base_scenes_are_refused(house: Scene, tmp_path: Path) -> None:
    for name, scene in (
        ("variant.json", replace(house, scene_id="two_bedroom_flat-train-001")),
        ("dash.json", replace(house, scene_id="my-flat", base="my-flat")),
    ):
        write_scene(tmp_path / name, scene)
        with pytest.raises(SceneFileError, match=f"{name} holds the scene .* expected a base scene"):
            base_scenes([str(tmp_path / name)])
    with pytest.raises(SceneFileError, match=r"build it with `embomatrix scene build .*flat.toml`"):
        base_scenes(["my/flat.toml"])


def test_two_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    write_scene(tmp_path / "mine.json", build_base_scene("Benevolence_1_int", seed=5))
    for others in (["Benevolence_1_int"], ["all"]):
        for order in ([*others, str(tmp_path / "mine.json")], [str(tmp_path / "mine.json"), *others]):
            with pytest.raises(SceneFileError, match="are both called 'Benevolence_1_int'"):
                base_scenes(order)
    assert base_scenes(["Rs_int", "all", "Rs_int"]) == BaseScenes(base_scenes(["Rs_int", "all"]).names)
    assert len(base_scenes(["all"]).names) == 51


def test_people_of_a_house_of_ones_own_ask_for_things(file: Path, house: Scene, tmp_path: Path) -> None:
    line = ("generate", "--tasks", 2, "--scenes", file, *QUICK)
    code, output = run(*line, "--out", tmp_path / "days")
    assert code == 0, output
    dataset = Dataset.load(tmp_path / "days")
    for record in dataset.records:
        assert record.task.task_id.startswith("two_bedroom_flat-train-")
        assert dataset.bundle(record.bundle_digest).scene.rooms == house.rooms
    assert_solved(dataset, dataset.records[0])
    assert read_scene(tmp_path / "days" / SCENES_FOLDER / "two_bedroom_flat.json") == house


def test_views_of_a_scene_file_are_not_shown_to_a_model(file: Path, tmp_path: Path) -> None:
    line = ("generate", "--out", tmp_path / "days", "--scenes", file, "--look")
    code, output = run(*line, "--llm", "http://127.0.0.1:1/v1", "--model", "none")
    assert code == 2
    assert "'two_bedroom_flat' comes from a file: --look shows scenes of the catalog only" in output
    assert not (tmp_path / "days").exists()
