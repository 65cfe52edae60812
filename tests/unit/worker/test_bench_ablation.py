"""The ablation and the look-ahead of `bench cluster`: every row does what its name says. No time is asserted tightly."""

import pytest
from tests.fakes.datasets import write_flats_dataset
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.cluster.ablation import AblationSizes, bench_ablation
from embomatrix.bench.cluster.ablation_page import ROWS, ablation_lines
from embomatrix.bench.cluster.cpu import CpuUse
from embomatrix.bench.cluster.prewarm import PrewarmSizes, bench_prewarm
from embomatrix.bench.cluster.work import main_work, whole_work
from embomatrix.bench.engine.workload import workload_to_text, write_workload
from embomatrix.bench.report.figures import BenchError, BenchResult
from embomatrix.bench.report.page import render_page
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.dataset import Dataset

PLANS = {
    "apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "light_and_air": "move table_lamp_1; toggle_on table_lamp_1; move fridge_1; open fridge_1",
}
SCENES = 3
PER_SCENE = 3
DELAY_S = 0.2

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return Dataset.load(write_flats_dataset(tmp_path_factory.mktemp("dataset"), SCENES, PLANS))


@pytest.fixture(scope="module")
def workload(dataset):
    return write_workload(dataset, seed=0, bodies=60, scenes=SCENES, plans=PER_SCENE)


@pytest.fixture(scope="module")
def work(dataset, workload):
    return main_work(dataset, workload)


@pytest.fixture(scope="module")
def figures(work):
    sizes = AblationSizes(naive=1, cached=3, singly=3, rounds=1, warm=1, delay_s=DELAY_S)
    return {figure.name: figure for figure in bench_ablation(work, sizes, lambda _: None)}


def quiet(_what):
    """Nobody follows the progress."""


def test_work_is_spread_over_the_scenes_and_names_every_plan_once(work, dataset, workload):
    rollouts = work.rollouts
    assert len({rollout.rollout_id for rollout in rollouts}) == len(rollouts) == SCENES * PER_SCENE
    assert len({rollout.bundle_digest for rollout in work.sample(SCENES)}) == SCENES
    assert len(work.first(1).rollouts) + len(work.after(1).rollouts) == len(rollouts)
    assert [len(step) for step in work.steps(2)] == [2 * PER_SCENE, PER_SCENE]
    assert set(whole_work(dataset, workload).bundles) == set(work.bundles)


def test_every_row_executes_the_work_that_it_says(figures):
    counts = {name: figure.n for name, figure in figures.items()}
    assert counts["ablation_naive_ms"] == counts["ablation_user_ms"] == 1
    assert counts["ablation_cached_ms"] == counts["ablation_scheduler_ms"] == 3
    assert counts["ablation_dispatcher_ms"] == counts["rollouts_per_s"] == SCENES * (PER_SCENE - 1)
    assert counts["ablation_scheduler_slow_ms"] == SCENES
    assert counts["ablation_dispatcher_slow_ms"] == SCENES * PER_SCENE
    assert all(figure.value >= 0 for figure in figures.values())


def test_the_first_row_is_slower_than_the_last_and_the_ratio_says_by_how_much(figures):
    naive, full = figures["ablation_naive_ms"].value, figures["ablation_dispatcher_ms"].value
    assert naive > full
    assert figures["ablation_ratio"].value == pytest.approx(naive / full)
    assert figures["ablation_ratio, equal cores"].value == pytest.approx(naive / full / 2)
    assert figures["rollouts_per_s"].value == pytest.approx(1e3 / full)


def test_slowed_loading_costs_every_rollout_of_the_rows_without_a_scheduler(figures):
    for row in ("naive", "cached"):
        slowed = figures[f"ablation_{row}_slow_ms"].value - figures[f"ablation_{row}_ms"].value
        assert slowed == pytest.approx(DELAY_S * 1e3)


def test_processor_time_outside_the_slots_is_their_share_of_all():
    used = CpuUse(slots_s=8.0, manager_s=0.5, daemons_s=1.0, trainer_s=0.5)
    assert used.overhead == pytest.approx(0.2)


def test_processor_time_is_told_by_who_used_it(figures):
    assert 0.0 < figures["overhead_ratio"].value < 1.0
    assert figures["CPU of a rollout: slots"].value > 0.0


def test_announced_scenes_are_warm_when_they_are_needed_though_loading_is_slow(work):
    sizes = PrewarmSizes(delay_s=0.5, pause_s=1.5, cold_scenes=1)
    found = {figure.name: figure for figure in bench_prewarm(work, sizes, quiet)}
    assert found["prewarm_hit_rate"].n == SCENES - 1
    assert found["prewarm_hit_rate"].value == 1.0
    assert found["prewarm_waste"].value == 0.0
    assert found["start of a scene, unannounced"].value > 500.0
    assert found["start_latency_ratio"].value < 1.0


def test_too_few_scenes_to_announce_are_refused(work):
    with pytest.raises(BenchError, match=f"too few scenes, {SCENES}: expected more than {SCENES}"):
        bench_prewarm(work, PrewarmSizes(cold_scenes=SCENES), quiet)


def test_the_page_shows_the_ablation_as_the_paper_does():
    measured = {
        "ablation_naive_ms": 3000.0,
        "ablation_cached_ms": 30.0,
        "ablation_scheduler_ms": 5.0,
        "ablation_dispatcher_ms": 2.0,
    }
    figures = tuple(Figure(name, value, "ms", Better.LOWER, 9) for name, value in measured.items())
    lines = ablation_lines(figures)
    assert "| naive | 3.48 | 1 × | 3,000 | 1 × |" in lines[2]
    assert "| + Task-Dispatcher | 0.07 | 49.7 × | 2 | 1,500 × |" in lines[5]
    machine = {"cpu": "a core", "cores": 2, "load_before": 0.1, "gpu": ""}
    page = render_page([BenchResult("cluster", "abc", machine, figures)], "")
    assert page.index("### The paper's ablation") < page.index("| + Task-Dispatcher |")
    assert ablation_lines(()) == []
    assert [row.paper_s for row in ROWS] == [3.48, 0.85, 0.14, 0.07]


def test_a_part_can_be_measured_alone(dataset, workload, tmp_path):
    path = tmp_path / "workload.json"
    path.write_text(workload_to_text(workload))
    options = [f"--engine-dataset={dataset.folder}", f"--workload={path}", "--part=prewarm"]
    answer = CliRunner().invoke(app, ["cluster", *options])
    assert answer.exit_code == 2
    assert "too few scenes, 3: expected more than 3" in " ".join(answer.output.split())
