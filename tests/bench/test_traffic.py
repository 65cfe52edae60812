"""Recorded traffic: the shipped sample, samples of other runs, and the replay."""

import dataclasses

import pytest
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.traffic.recording import recorded_traffic, sampled_traffic, save_sample
from embomatrix.bench.traffic.replay import TrafficSizes, bench_traffic, elsewhere
from embomatrix.rpc.traffic import TrafficLog
from embomatrix.rpc.wire.values import Batch, Rollout
from embomatrix.skills.parse import parse_plan
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}
TEXTS = ("move 0; pick_up 0", "move 0", "move 0; pick_up 0", "move 1; pick_up 1", "move 0; pick_up 0; move 1")


@pytest.fixture
def record(tmp_path):
    """Return a record of three steps in two scenes, and their dataset."""
    folder = write_flats_dataset(tmp_path / "dataset", 2, PLANS)
    dataset = Dataset.load(folder)
    log = TrafficLog(tmp_path / "traffic.jsonl")
    for step in range(1, 4):
        rollouts = tuple(
            Rollout(
                f"{step}/{row}/{number}", f"{row}", one.bundle_digest, one.task.task_id, parse_plan(text), 7
            )
            for row, one in enumerate(dataset.records)
            for number, text in enumerate(TEXTS)
        )
        log.append(Batch("r", f"step-{step}-0", step, rollouts))
    log.append(Batch("r", "before-GRPO-0", 0, rollouts))
    log.close()
    return tmp_path / "traffic.jsonl", folder


def test_shipped_sample_has_its_scenes_and_tasks():
    traffic = sampled_traffic()
    assert len(traffic.bundles) == 18
    assert sum(len(group.members) for group in traffic.early) == 1_152
    assert sum(len(group.members) for group in traffic.late) == 1_152
    bundles = {digest: decode_bundle(data, digest=digest) for digest, data in traffic.bundles.items()}
    for group in (*traffic.early, *traffic.late):
        assert group.task_id in bundles[group.bundle_digest].tasks
        assert len(group.rollouts()) == 8


def test_sample_of_a_record_has_all_groups_of_its_scenes(tmp_path, record):
    whole = recorded_traffic(*record)
    assert (len(whole.early), len(whole.bundles)) == (6, 2)
    save_sample(*record, tmp_path / "sample", scenes=1, seed=0)
    sample = sampled_traffic(tmp_path / "sample")
    assert (len(sample.early), len(sample.bundles)) == (3, 1)
    assert [group.plans for group in sample.early] == [group.plans for group in whole.early[:3]]
    (digest,) = sample.bundles
    assert {group.bundle_digest for group in sample.early} == {digest}


def test_record_of_another_dataset_is_refused(tmp_path, record):
    other = write_flats_dataset(tmp_path / "other", 1, {})
    with pytest.raises(BenchError, match="is of other scenes than"):
        recorded_traffic(record[0], other)


def test_warm_up_reaches_no_state_of_the_traffic(record):
    rollouts = recorded_traffic(*record).early[0].rollouts()
    moved = [*elsewhere(rollouts, 0), *elsewhere(rollouts, 1)]
    assert [one.plan[1:] for one in moved] == 2 * [one.plan for one in rollouts]
    first_calls = {one.plan[0] for one in moved}
    assert len(first_calls) == 2
    assert not first_calls & {one.plan[0] for one in rollouts}
    assert len({one.rollout_id for one in moved}) == len(moved)


@pytest.mark.timeout(200)
def test_replay_counts_every_rollout_and_shares_steps(record):
    traffic = recorded_traffic(*record)
    sizes = TrafficSizes(peers=(), slots=1, rounds=1, batch=2, in_flight=2, limit_s=90.0)
    figures = {figure.name: figure for figure in bench_traffic(traffic, sizes, lambda _: None)}
    assert figures["traffic_rollouts_per_s"].n == 6 * len(TEXTS)
    assert figures["traffic_rollouts_per_s_late, no sharing"].value > 0
    # All steps repeat those of the first group, in each of two scenes; warm-up shares nothing with them.
    assert figures["shared_step_share"].value > 0.5
    assert dataclasses.replace(figures["shared_step_share"], value=0.0).goal == 0.65
