"""Benches hand in figures of one format, show them, and never lose what people wrote on the page. No time is asserted."""

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
from embomatrix.bench.engine.scenes import scenes_of
from embomatrix.bench.engine.workload import read_workload, workload_to_text, write_workload
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.report.page import END
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
def workload(dataset, tmp_path_factory):
    """Three plans in each of two flats."""
    path = tmp_path_factory.mktemp("workload") / "workload.json"
    result = _bench(
        "workload", f"--dataset={dataset}", f"--out={path}", "--bodies=60", "--scenes=2", "--plans=3"
    )
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture(scope="module")
def everything(dataset, workload, tmp_path_factory):
    """What `bench all` printed, and the folder that it wrote to."""
    out = tmp_path_factory.mktemp("out")
    page = f"{out / 'benchmarks.md'}"
    engine = (f"--engine-dataset={dataset}", f"--workload={workload}", "--cycles=80")
    result = _bench(
        "all",
        f"--dataset={dataset}",
        f"--out={page}",
        f"--json-dir={out}",
        "--limit-s=200",
        "--part=phases",
        *engine,
    )
    assert result.exit_code == 0, result.output
    return result.output, out


def _bench(*arguments):
    return CliRunner().invoke(app, arguments)


def _figures(folder, bench):
    written = json.loads((folder / f"{bench}.json").read_text())
    return {figure["name"]: figure for figure in written["figures"]}


@pytest.mark.parametrize("bench", ["engine", "rollout", "cluster"])
def test_every_bench_writes_the_one_format_and_prints_the_same(everything, bench):
    printed, folder = everything
    written = json.loads((folder / f"{bench}.json").read_text())
    assert set(written) == {"bench", "commit", "machine", "figures"}
    assert written["bench"] == bench
    assert COMMIT.fullmatch(written["commit"])
    assert {"cpu", "cores", "memory_gb", "load_before", "python", "pybullet"} <= set(written["machine"])
    assert f"bench {bench} at" in printed
    for figure in written["figures"]:
        assert set(figure) == FIGURE_KEYS
        assert figure["better"] in ("higher", "lower")
        assert figure["n"] > 0
        assert figure["value"] > 0 or (figure["value"] == 0 and figure["unit"] in MAY_BE_ZERO), figure
        assert figure["name"].split()[0] in printed


def test_rollouts_are_measured_skill_by_skill_and_reach_their_goals(everything):
    figures = _figures(everything[1], "rollout")
    for skill in ("move", "pick_up", "open", "toggle_on", "place with settling"):
        assert f"skill {skill}, p50" in figures
    assert "skill close, p50" not in figures
    assert figures["oracle plans that reach their goal"]["value"] == 1.0
    assert figures["rollout, p50"]["n"] == SCENES * len(PLANS) * 3
    # The bundles have no pose cache: every pose is verified when it is asked for.
    assert figures["places that needed a settle"]["value"] == 1.0


def test_the_engine_is_measured_by_the_names_that_goals_are_set_for_and_by_size(everything):
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
    }
    assert {name.split(" at ")[1] for name in figures if " at " in name} == {"60 bodies"}
    assert figures["calls_succeeded"] | {"value": 1.0} == figures["calls_succeeded"]
    assert figures["rollout_p50_ms"]["n"] == 2 * 3
    # The bundles have no pose cache: what statics does not prove is settled.
    assert 0.0 < figures["places_settled_live"]["value"] < 1.0


def test_plans_of_a_workload_differ_and_have_the_shape_that_is_promised(workload):
    written = read_workload(workload)
    assert [scene.bodies for scene in written.main] == [15, 15]
    for scene in written.scenes:
        plans = [item.plan for item in scene.executions]
        assert len(set(zip((item.task_id for item in scene.executions), plans, strict=True))) == 3
        for plan in plans:
            skills = Counter(call.skill for call in plan)
            assert skills == {Skill.MOVE: 5, Skill.PICK_UP: 2, Skill.PLACE: 2, Skill.OPEN: 1}


def test_equal_seeds_and_datasets_give_equal_workloads(dataset, workload):
    again = write_workload(Dataset.load(dataset), seed=0, bodies=60, scenes=2, plans=3)
    assert again == read_workload(workload)
    assert workload_to_text(again) == workload.read_text()


def test_a_workload_for_other_scenes_is_refused_before_anything_is_measured(dataset, workload, tmp_path):
    whole = Dataset.load(dataset)
    [known] = {scene.bundle_digest for scene in read_workload(workload).scenes[:1]}
    records = [record for record in whole.records if record.bundle_digest != known]
    write_dataset(
        tmp_path, records, {key: whole.bundle_bytes(key) for key in {r.bundle_digest for r in records}}
    )
    result = _bench("engine", f"--dataset={tmp_path}", f"--workload={workload}")
    assert result.exit_code == 2
    assert "lacks scene" in result.stderr
    assert "embomatrix bench workload" in result.stderr


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("{", "Expecting property name"),
        ('{"format": 2, "seed": 0, "bodies": 60, "scenes": []}', "found 2"),
        ('{"format": 1, "seed": 0, "bodies": 60}', "lacks 'scenes'"),
        (
            '{"format": 1, "seed": 0, "bodies": 60, "scenes": '
            '[{"scene_id": "a", "bundle": "b", "bodies": 3, "executions": ["t 1: fly 3"]}]}',
            "fly",
        ),
    ],
)
def test_a_damaged_workload_is_named_with_the_remedy(tmp_path, text, found):
    path = tmp_path / "workload.json"
    path.write_text(text)
    with pytest.raises(BenchError, match=rf"{path}.*{found}.*embomatrix bench workload"):
        read_workload(path)


def test_scenes_are_cold_unless_they_were_announced_or_used(everything):
    figures = _figures(everything[1], "cluster")
    assert figures["cold: scenes warm on arrival"]["value"] == 0.0
    assert figures["prewarmed: scenes warm on arrival"]["value"] == 1.0
    assert figures["repeated: scenes warm on arrival"]["value"] == 1.0
    assert figures["rollouts without a result"]["value"] == 0.0
    assert figures["latency, cold over prewarmed"]["unit"] == "×"


def test_the_page_has_the_machine_a_table_for_each_bench_and_a_part_for_people(everything):
    page = (everything[1] / "benchmarks.md").read_text()
    assert re.search(rf"\| commit \| `{COMMIT.pattern}` \|", page)
    assert (
        page.index("## Engine")
        < page.index("## One process")
        < page.index("## Cluster on loopback")
        < page.index("## Training runs")
    )
    assert page.count("| figure | value | goal | | n |") == 3
    assert "<!-- by hand: training -->\n" + END in page
    assert not re.search(r"20\d\d-\d\d", page), "a page without a date changes only when its figures do"


def test_one_bench_alone_writes_no_file_unless_asked(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = _bench("rollout", f"--dataset={dataset}", "--scenes=1", "--repeats=1")
    assert result.exit_code == 0, result.output
    assert "rollouts on one core" in result.output
    assert os.listdir(tmp_path) == []


def test_a_folder_without_a_data_set_is_told_how_to_build_one(tmp_path):
    result = _bench("rollout", f"--dataset={tmp_path}")
    assert result.exit_code == 2
    assert "there is no dataset in" in result.stderr
    assert "embomatrix factory build" in result.stderr


def test_too_few_scenes_for_a_cold_and_a_warm_phase_are_refused_at_once(dataset, tmp_path):
    whole = Dataset.load(dataset)
    first = whole.records[0]
    write_dataset(tmp_path, [first], {first.bundle_digest: whole.bundle_bytes(first.bundle_digest)})
    result = _bench("cluster", f"--dataset={tmp_path}")
    assert result.exit_code == 2
    assert "the dataset has too few scenes, 1: expected at least 3" in " ".join(result.stderr.split())


def test_an_empty_data_set_is_named(tmp_path):
    write_dataset(tmp_path, [], {})
    with pytest.raises(BenchError, match="has no tasks"):
        scenes_of(Dataset.load(tmp_path), 3)


def test_scenes_are_spread_over_the_data_set(dataset):
    whole = Dataset.load(dataset)
    digests = list(dict.fromkeys(record.bundle_digest for record in whole.records))
    assert [scene.bundle_digest for scene in scenes_of(whole, 3)] == [digests[0], digests[2], digests[4]]
    assert [scene.bundle_digest for scene in scenes_of(whole, 99)] == digests
    assert all(len(scene.demonstrations) == len(PLANS) for scene in scenes_of(whole, 3))


def test_processes_of_the_cluster_end_with_the_bench(tmp_path):
    with bench_cluster(tmp_path, workers=1, slots=1, deadline_s=time.monotonic() + 60) as cluster:
        pids = [process.child.pid for process in cluster.processes]
        assert cluster.workers == {"worker-1"}
        cluster.check()
        cluster.processes[1].child.kill()
        cluster.processes[1].child.wait()
        with pytest.raises(BenchError, match="worker-1 ended with status -9"):
            cluster.check()
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_a_manager_that_can_not_serve_is_told_with_the_end_of_its_log(tmp_path):
    (tmp_path / "manager").write_text("a file where its folder should be")
    with (
        pytest.raises(BenchError, match=r"manager ended with status \d+: "),
        bench_cluster(tmp_path, workers=1, slots=1, deadline_s=time.monotonic() + 60),
    ):
        pass


def test_a_page_that_can_not_be_replaced_is_refused_before_anything_is_measured(dataset, tmp_path):
    page = tmp_path / "notes.md"
    page.write_text("# My notes\n")
    result = _bench("all", f"--dataset={dataset}", f"--out={page}")
    assert result.exit_code == 2
    assert "not written by this command" in result.stderr
    assert page.read_text() == "# My notes\n"
