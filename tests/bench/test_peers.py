"""Contest with peers: they execute the same plans in the same simulator, and losses are counted. No time is asserted."""

import contextlib
import time

import pytest
from tests.fakes.contender import FakeContender
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.engine.plan_writer import save_workload, write_workload
from embomatrix.bench.engine.workload import load_workload
from embomatrix.bench.peers.contenders import ContenderSetup, Lost, own_cluster, process_pool
from embomatrix.bench.peers.contest import (
    PeerSizes,
    PeerSystem,
    _measured,
    await_processes,
    bench_peers,
    chunks_of,
    execute,
    measure_peer,
    run_apart,
    singles,
)
from embomatrix.bench.peers.scene_process import executed_twice, write_bundles
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.report.page import peer_lines
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}
SCENES = 2
PER_SCENE = 60
MEASURED = SCENES * (PER_SCENE - 1)
LIMIT_S = 60.0
SIZES = PeerSizes((PeerSystem.POOL,), chunk=2, warm=1, alone=1, waves=1, wave=2, limit_s=LIMIT_S)

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    dataset = Dataset.load(write_flats_dataset(tmp_path_factory.mktemp("dataset"), SCENES, PLANS))
    written = write_workload(
        dataset, seed=0, bodies=60, scenes=SCENES, plans=PER_SCENE, on_scene=lambda _scene_id: None
    )
    save_workload(dataset, written, dataset.folder)
    return load_workload(dataset.folder)


def test_chunks_hold_rollouts_of_one_scene(work):
    chunks = chunks_of(work.rollouts, 3)
    assert [rollout for chunk in chunks for rollout in chunk] == list(work.rollouts)
    assert [len(chunk) for chunk in chunks] == [3] * (SCENES * PER_SCENE // 3)
    assert all(len({rollout.bundle_digest for rollout in chunk}) == 1 for chunk in chunks)


def test_processes_of_a_pool_execute_as_our_simulator_does(work, tmp_path):
    write_bundles(tmp_path, work.bundles)
    theirs = []
    setup = ContenderSetup(tmp_path, 1, tuple(work.bundles))
    with process_pool(setup) as contender:
        contender.run(chunks_of(work.rollouts, 2), lambda news: theirs.extend(news.results), LIMIT_S)
    assert sorted(result.trace_digest for result in theirs) == sorted(traces(work))
    assert executed_twice(tmp_path) == 0


def traces(work):
    """Yield the trace digest of each plan."""
    for digest, data in work.bundles.items():
        bundle = decode_bundle(data)
        with contextlib.closing(load_simulator(bundle)) as simulator:
            for rollout in work.rollouts:
                if rollout.bundle_digest == digest:
                    yield simulator.execute(bundle.tasks[rollout.task_id], rollout.plan, rollout.seed).digest


@pytest.mark.slow
def test_killed_slot_costs_our_cluster_nothing(work, tmp_path):
    write_bundles(tmp_path, work.bundles)
    setup = ContenderSetup(tmp_path, 2, tuple(work.bundles))
    with own_cluster(setup, work) as contender:
        killed = _measured(contender, setup, work, SIZES).killed
    assert (killed.lost, killed.hung) == (0, 0)
    assert len(killed.latency_s) == MEASURED


@pytest.mark.slow
def test_rollouts_that_a_pool_gives_up_are_counted(work):
    found = measure_peer(PeerSystem.POOL, work, SIZES)
    assert len(found.all_at_once.latency_s) == MEASURED
    killed = found.killed
    assert len(killed.latency_s) + killed.lost + killed.hung == MEASURED
    assert set(killed.reasons) <= {"BrokenProcessPool"}


@pytest.mark.slow
def test_contest_compares_ours_with_a_peer(work):
    found = bench_peers(work, SIZES, lambda _: None)
    figures = {figure.name: figure for figure in found}
    ours, peer = (figures[f"contest, {name}: rollouts, 1/s"].value for name in ("ours", "process_pool"))
    assert figures["vs_process_pool"].value == pytest.approx(ours / peer)
    assert "vs_ray" not in figures
    assert [line.split(" | ")[0] for line in peer_lines(found)[2:]] == ["| ours", "| process pool"]
    assert peer_lines(()) == []


def test_lost_and_unanswered_rollouts_are_counted_apart(work):
    chunks = singles(work.rollouts)
    contender = FakeContender({0: Lost(1, "Broken"), 1: None})
    outcome = execute(contender, chunks, LIMIT_S)
    assert (outcome.lost, outcome.hung) == (1, 1)
    assert outcome.reasons == {"Broken": 1}
    assert len(outcome.latency_s) == len(chunks) - 2


def test_processes_that_do_not_start_are_an_error_with_the_reason():
    with pytest.raises(BenchError, match=r"did not start within 0\.1 s: NoModule"):
        await_processes(FakeContender({0: Lost(0, "NoModule")}), 2, 0.1)
    with pytest.raises(BenchError, match="1 of 2 processes answered"):
        await_processes(FakeContender({}), 2, 0.1)


def test_measurement_in_another_process_returns_a_result_or_a_reason():
    assert run_apart(divmod, (7, 2), LIMIT_S) == (3, 1)
    assert run_apart(divmod, (7, 0), LIMIT_S).startswith("ZeroDivisionError")
    assert run_apart(time.sleep, (60,), 0.5) == "it was not done within 0.5 s"
