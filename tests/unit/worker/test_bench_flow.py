"""The flow: a real manager, a worker that executes nothing, and figures of every rollout that went through."""

import pytest
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.cluster.flow import FlowSizes, bench_flow
from embomatrix.bench.cluster.work import main_work
from embomatrix.bench.engine.workload import write_workload
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}


@pytest.mark.timeout(120)
def test_every_rollout_that_flows_through_the_manager_is_counted(tmp_path):
    dataset = Dataset.load(write_flats_dataset(tmp_path, 1, PLANS))
    work = main_work(dataset, write_workload(dataset, seed=0, bodies=60, scenes=1, plans=2))
    said = []
    sizes = FlowSizes(slots=2, in_flight=64, batches=3, most=128, limit_s=90.0)
    figures = {figure.name: figure for figure in bench_flow(work, sizes, said.append)}
    assert figures["manager_cpu_us"].n == 3 * 64
    assert figures["manager_cpu_us"].value > 0
    assert figures["dispatch_p99_ms"].n > 0
    assert figures["manager_rss_mb_16k"].n == 128
    embedded, redis = said[: said.index("the same with Redis")], said[said.index("the same with Redis") :]
    assert embedded[-1] == "128 rollouts in flight that nobody executes"
    assert redis[-1] == "64 rollouts in flight"
    assert figures["manager_cpu_us, with Redis"].n == 3 * 64
    assert figures["CPU of redis-server for a rollout"].n == 3 * 64
