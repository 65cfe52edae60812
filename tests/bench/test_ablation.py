"""Ablation and look-ahead of `bench cluster`: every row executes the work it names. No time is asserted tightly."""

import pytest
from tests.fakes.datasets import write_flats_dataset
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.cluster.ablation import AblationSizes, bench_ablation
from embomatrix.bench.cluster.cpu import CpuUse
from embomatrix.bench.cluster.prewarm import PrewarmSizes, bench_prewarm
from embomatrix.bench.engine.plan_writer import save_workload, write_workload
from embomatrix.bench.engine.workload import load_workload
from embomatrix.bench.report.figures import BenchError
from embomatrix.world.dataset import Dataset

PLANS = {
    "apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "light_and_air": "move table_lamp_1; toggle_on table_lamp_1; move fridge_1; open fridge_1",
}
SCENES = 3
PER_SCENE = 15  # CPU time is counted in ticks of 10 ms: six rollouts may take less than one
DELAY_S = 0.2

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return Dataset.load(write_flats_dataset(tmp_path_factory.mktemp("dataset"), SCENES, PLANS))


@pytest.fixture(scope="module")
def work(dataset):
    written = write_workload(
        dataset, seed=0, bodies=60, scenes=SCENES, plans=PER_SCENE, on_scene=lambda _scene_id: None
    )
    save_workload(dataset, written, dataset.folder)
    return load_workload(dataset.folder)


@pytest.fixture(scope="module")
def figures(work):
    sizes = AblationSizes(naive=1, cached=3, singly=3, rounds=1, warm=1, delay_s=DELAY_S)
    return {figure.name: figure for figure in bench_ablation(work, sizes, lambda _: None)}


def quiet(_step):
    """Ignore progress."""


def test_sample_is_spread_over_the_scenes_and_every_plan_has_one_rollout(work):
    rollouts = work.rollouts
    assert len({rollout.rollout_id for rollout in rollouts}) == len(rollouts) == SCENES * PER_SCENE
    assert len({rollout.bundle_digest for rollout in work.sample(SCENES)}) == SCENES
    assert len(work.first(1).rollouts) + len(work.after(1).rollouts) == len(rollouts)
    assert [len(step) for step in work.steps(2)] == [2 * PER_SCENE, PER_SCENE]
    assert work.main == work


def test_every_row_executes_its_number_of_rollouts(figures):
    counts = {name: figure.n for name, figure in figures.items()}
    assert counts["ablation_naive_ms"] == 1
    assert counts["ablation_cached_ms"] == counts["ablation_scheduler_ms"] == 3
    assert counts["ablation_dispatcher_ms"] == counts["rollouts_per_s"] == SCENES * (PER_SCENE - 1)
    assert counts["ablation_scheduler_slow_ms"] == SCENES
    assert counts["ablation_dispatcher_slow_ms"] == SCENES * PER_SCENE
    assert all(figure.value >= 0 for figure in figures.values())


def test_ratio_compares_the_first_row_with_the_last(figures):
    naive, full = figures["ablation_naive_ms"].value, figures["ablation_dispatcher_ms"].value
    assert naive > full
    assert figures["ablation_ratio"].value == pytest.approx(naive / full)
    assert figures["ablation_ratio, equal cores"].value == pytest.approx(naive / full / 2)
    assert figures["rollouts_per_s"].value == pytest.approx(1e3 / full)


def test_slowed_loading_delays_every_rollout_of_the_rows_without_a_scheduler(figures):
    for row in ("naive", "cached"):
        slowed = figures[f"ablation_{row}_slow_ms"].value - figures[f"ablation_{row}_ms"].value
        assert slowed == pytest.approx(DELAY_S * 1e3)


def test_overhead_is_the_share_of_cpu_time_outside_the_slots():
    used = CpuUse(slots_s=8.0, manager_s=0.5, daemons_s=1.0, trainer_s=0.5)
    assert used.overhead == pytest.approx(0.2)


def test_cpu_time_is_split_by_process(figures):
    assert 0.0 < figures["overhead_ratio"].value < 1.0
    assert figures["CPU of a rollout: slots"].value > 0.0


def test_announced_scenes_are_warm_in_time_despite_slow_loading(work):
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


def test_part_can_be_measured_alone(work, dataset):
    answer = CliRunner().invoke(app, ["cluster", f"--dataset={dataset.folder}", "--part=prewarm"])
    assert answer.exit_code == 2
    assert "too few scenes, 3: expected more than 3" in " ".join(answer.output.split())
