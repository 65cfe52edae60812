"""Benchmarks from the command line: one format of figures, a page that keeps other text, refusals with a remedy."""

import json
import os
import re
import time
from collections import Counter

import psutil
import pytest
from tests.fakes.datasets import write_flats_dataset
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.engine.plan_writer import write_workload
from embomatrix.bench.engine.workload import read_workload, workload_to_text
from embomatrix.bench.report.figures import BenchError, read_result
from embomatrix.skills.syntax import Skill
from embomatrix.world.dataset import Dataset, write_dataset

PLANS = {
    "apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "light_and_air": "move table_lamp_1; toggle_on table_lamp_1; move fridge_1; open fridge_1",
}
SCENES = 5
FIGURE_KEYS = {"name", "value", "unit", "goal", "better", "n"}
COMMIT = re.compile(r"[0-9a-f]{12}(?:-dirty)?|version \S+")
MAY_BE_ZERO = {"share", "count", "kB"}

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """The flat five times, under five names, with two tasks each."""
    return write_flats_dataset(tmp_path_factory.mktemp("dataset"), SCENES, PLANS)


@pytest.fixture(scope="module")
def workload(dataset):
    """Workload of the dataset: three plans in each of five flats."""
    answer = _bench("workload", f"--dataset={dataset}", "--bodies=60", "--scenes=5", "--plans=3")
    assert answer.exit_code == 0, answer.output
    return dataset / "workload.json"


@pytest.fixture(scope="module")
def everything(dataset, workload, tmp_path_factory):
    """Output of `bench all`, and the folder that it wrote to."""
    out = tmp_path_factory.mktemp("out")
    options = (f"--json-dir={out}", "--limit-s=200", "--part=prewarm", "--cycles=80")
    result = _bench("all", f"--dataset={dataset}", f"--out={out / 'benchmarks.md'}", *options)
    assert result.exit_code == 0, result.output
    return result.output, out


def _bench(*arguments):
    return CliRunner().invoke(app, arguments)


def _figures(folder, bench):
    written = json.loads((folder / f"{bench}.json").read_text())
    return {figure["name"]: figure for figure in written["figures"]}


@pytest.mark.parametrize("bench", ["engine", "cluster"])
def test_benchmarks_share_one_format_and_print_their_file(everything, bench):
    printed, folder = everything
    written = json.loads((folder / f"{bench}.json").read_text())
    assert set(written) == {"bench", "commit", "machine", "figures"}
    assert written["bench"] == bench
    assert COMMIT.fullmatch(written["commit"])
    assert {"cpu", "cores", "memory_gb", "load_before", "python", "pybullet"} <= set(written["machine"])
    assert f"{bench} at" in printed
    for figure in written["figures"]:
        assert set(figure) == FIGURE_KEYS
        assert figure["better"] in ("higher", "lower")
        assert figure["n"] > 0
        assert figure["value"] > 0 or (figure["value"] == 0 and figure["unit"] in MAY_BE_ZERO), figure
        assert figure["name"].split()[0] in printed


def test_rollouts_are_measured_skill_by_skill(everything):
    figures = _figures(everything[1], "engine")
    for skill in ("move", "pick_up", "open", "place with settling"):
        assert f"skill {skill}, p50" in figures
    assert "skill close, p50" not in figures
    assert figures["decode a bundle, p50"]["n"] == SCENES


def test_engine_has_figures_with_goals_and_figures_by_size(everything):
    figures = _figures(everything[1], "engine")
    goals = {name for name, figure in figures.items() if figure["goal"] is not None}
    assert goals == {
        *(
            "cold_load_ms",
            "slot_respawn_ms",
            "reset_ms",
            "rollout_p50_ms",
            "rollout_p99_ms",
            "rollouts_per_s",
        ),
        *("private_mb_per_slot", "leak_kb_per_cycle", "poses_per_s", "analysis_s"),
        *("build a scene, p50", "bundle to ready simulator, p50"),
        *(name for name in figures if name.startswith("skill ")),
    }
    assert {name.split(" at ")[1] for name in figures if " at " in name} == {"60 bodies"}
    assert figures["calls_succeeded"] | {"value": 1.0} == figures["calls_succeeded"]
    assert figures["rollout_p50_ms"]["n"] == SCENES * 3
    # The bundles have no pose cache: what statics does not prove is settled.
    assert 0.0 < figures["places_settled_live"]["value"] < 1.0


def test_plans_of_a_workload_differ_and_have_five_moves_two_places_and_a_door(workload):
    written = read_workload(workload)
    assert [scene.bodies for scene in written.main.scenes] == [15] * SCENES
    for scene in written.scenes:
        plans = [item.plan for item in scene.executions]
        assert len(set(zip((item.task_id for item in scene.executions), plans, strict=True))) == 3
        for plan in plans:
            skills = Counter(call.skill for call in plan)
            assert skills == {Skill.MOVE: 5, Skill.PICK_UP: 2, Skill.PLACE: 2, Skill.OPEN: 1}


def test_equal_seeds_and_datasets_give_equal_workloads(dataset, workload):
    again = write_workload(
        Dataset.load(dataset), seed=0, bodies=60, scenes=5, plans=3, on_scene=lambda _scene_id: None
    )
    assert again == read_workload(workload)
    assert workload_to_text(again) == workload.read_text()


def test_workload_of_other_scenes_is_refused_with_the_remedy(dataset, workload, tmp_path):
    whole = Dataset.load(dataset)
    write_dataset(tmp_path, [], {})
    answer = _bench("engine", f"--dataset={tmp_path}")
    assert answer.exit_code == 2
    assert "no workload can be read from" in answer.stderr
    (tmp_path / "workload.json").write_text(workload.read_text())
    answer = _bench("engine", f"--dataset={tmp_path}")
    assert answer.exit_code == 2
    assert "is of other scenes" in answer.stderr
    assert f"embomatrix bench workload --dataset={tmp_path}" in answer.stderr
    assert whole.records


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("{", "Input data was truncated"),
        ('{"format": 2, "seed": 0, "bodies": 60, "scenes": []}', "found 2"),
        ('{"format": 1, "seed": 0, "bodies": 60}', "missing required field `scenes`"),
        (
            '{"format": 1, "seed": 0, "bodies": 60, "scenes": '
            '[{"scene_id": "a", "bundle": "b", "bodies": 3, "executions": ["t 1: fly 3"]}]}',
            "fly",
        ),
    ],
)
def test_damaged_workload_is_named_with_the_remedy(tmp_path, text, found):
    path = tmp_path / "workload.json"
    path.write_text(text)
    with pytest.raises(BenchError, match=rf"{path}.*{found}.*embomatrix bench workload"):
        read_workload(path)


def test_page_has_a_table_of_each_benchmark(everything):
    page = (everything[1] / "benchmarks.md").read_text()
    assert re.search(rf"Commit `{COMMIT.pattern}`, ", page)
    assert page.index("## Engine") < page.index("## Cluster")
    assert page.count("| figure | value | goal |  | n |") == 2
    assert not re.search(r"20\d\d-\d\d", page), "a page without a date changes only with its figures"


def test_benchmark_writes_no_file_unless_asked(dataset, workload, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = _bench("engine", f"--dataset={dataset}", "--cycles=80")
    assert result.exit_code == 0, result.output
    assert "rollouts_per_s" in result.output
    assert os.listdir(tmp_path) == []


def test_folder_without_a_dataset_is_refused_with_a_remedy(tmp_path):
    result = _bench("engine", f"--dataset={tmp_path}")
    assert result.exit_code == 2
    assert "there is no dataset in" in result.stderr
    assert "embomatrix factory starter" in result.stderr


def test_too_few_scenes_for_a_workload_are_refused(dataset, tmp_path):
    result = _bench(
        "workload", f"--dataset={dataset}", f"--out={tmp_path}", "--bodies=60", "--scenes=9", "--plans=1"
    )
    assert result.exit_code == 2
    assert "has 5 scenes of about 60 bodies" in " ".join(result.stderr.split())
    assert os.listdir(tmp_path) == []


def test_processes_of_the_cluster_end_with_the_benchmark(tmp_path):
    with bench_cluster(tmp_path, workers=1, slots=1, deadline_s=time.monotonic() + 60) as cluster:
        pids = [process.child.pid for process in cluster.processes]
        assert cluster.workers == {"worker-1"}
        cluster.check()
        cluster.processes[1].child.kill()
        cluster.processes[1].child.wait()
        with pytest.raises(BenchError, match="worker-1 ended with status -9"):
            cluster.check()
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_failed_manager_is_reported_with_the_end_of_its_log(tmp_path):
    (tmp_path / "manager").write_text("a file where its folder should be")
    with (
        pytest.raises(BenchError, match=r"manager ended with status \d+: "),
        bench_cluster(tmp_path, workers=1, slots=1, deadline_s=time.monotonic() + 60),
    ):
        pass


def test_unwritable_page_is_refused_before_the_measurement(dataset, tmp_path):
    page = tmp_path / "notes.md"
    page.write_text("# My notes\n")
    result = _bench("all", f"--dataset={dataset}", f"--out={page}")
    assert result.exit_code == 2
    assert "has no marks" in result.stderr
    assert page.read_text() == "# My notes\n"


@pytest.mark.slow
def test_simulation_command_writes_its_figures(tmp_path):
    path = tmp_path / "figures.json"
    answer = CliRunner().invoke(app, ["simulation", "--most-workers=10", f"--json={path}"])
    assert answer.exit_code == 0, answer.output
    found = {figure.name: figure.value for figure in read_result(path).figures}
    assert found["sim_broken_invariants"] == 0
    assert found["sim_hit_rate, k=2"] >= 0.95
    assert found["sim_slots_at_work, 150 µs a rollout, 80 slots"] >= 0.9
