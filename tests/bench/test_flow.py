"""Flow through a real manager with a null worker: figures count every rollout."""

import pytest
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.cluster.flow import FlowSizes, bench_flow
from embomatrix.bench.engine.plan_writer import save_workload, write_workload
from embomatrix.bench.engine.workload import load_workload
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}


@pytest.mark.timeout(120)
def test_every_rollout_through_the_manager_is_counted(tmp_path):
    dataset = Dataset.load(write_flats_dataset(tmp_path, 1, PLANS))
    written = write_workload(dataset, seed=0, bodies=60, scenes=1, plans=2, on_scene=lambda _scene_id: None)
    save_workload(dataset, written, tmp_path)
    work = load_workload(tmp_path)
    said = []
    sizes = FlowSizes(slots=2, in_flight=64, batches=3, most=128, limit_s=90.0)
    figures = {figure.name: figure for figure in bench_flow(work, sizes, said.append)}
    assert figures["manager_cpu_us"].n == 3 * 64
    assert figures["manager_cpu_us"].value > 0
    assert figures["dispatch_p99_ms"].n > 0
    assert figures["manager_rss_mb_16k"].n == 128
    embedded, redis = said[: said.index("the same with Redis")], said[said.index("the same with Redis") :]
    assert embedded[-1] == "128 rollouts in flight without a worker"
    assert redis[-1] == "64 rollouts in flight"
    assert figures["manager_cpu_us, with Redis"].n == 3 * 64
    assert figures["CPU of redis-server for a rollout"].n == 3 * 64
