"""Turns through a real cluster: every call of every episode is counted."""

from itertools import islice

import pytest
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.engine.plan_writer import save_workload, write_workload
from embomatrix.bench.engine.workload import load_workload
from embomatrix.bench.traffic.turns import TurnSizes, bench_turns, episode_scripts
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}


@pytest.fixture
def workload(tmp_path):
    dataset = Dataset.load(write_flats_dataset(tmp_path, 1, PLANS))
    written = write_workload(dataset, seed=0, bodies=60, scenes=1, plans=2, on_scene=lambda _scene_id: None)
    save_workload(dataset, written, tmp_path)
    return load_workload(tmp_path)


def test_no_two_episodes_have_equal_task_and_seed(workload):
    scripts = list(islice(episode_scripts(workload, 20), 50))
    assert len({(script.task_id, script.seed) for script in scripts}) == 50
    assert {len(script.calls) for script in scripts} == {20}


@pytest.mark.timeout(120)
def test_every_turn_is_counted(workload):
    said = []
    sizes = TurnSizes(calls=12, alone=2, together=4, rounds=2, slots=1, limit_s=90.0)
    figures = {figure.name: figure for figure in bench_turns(workload, sizes, said.append)}
    assert said == ["episodes one after another", "4 episodes at a time"]
    assert figures["step_p50_ms"].n == 2 * 12
    assert figures["turns_per_s"].n == 4 * 2 * 12
    assert 0 < figures["step_p50_ms"].value <= figures["step_p99_ms"].value
    assert figures["turns_per_s"].value > 0
