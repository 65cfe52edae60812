"""The contest: peers execute the same plans in the same simulator, and what they lose is counted. Times are not asserted."""

import contextlib
import time

import pytest
from tests.fakes.contender import FakeContender
from tests.fakes.datasets import write_flats_dataset

from embomatrix.bench.cluster.work import main_work
from embomatrix.bench.engine.apart import apart
from embomatrix.bench.engine.workload import write_workload
from embomatrix.bench.peers.contender import ContenderSetup, LibraryMode, Lost, RolloutChunk, execute, greet
from embomatrix.bench.peers.contest import PeerSizes, PeerSystem, chunks_of, hold_contest, singles
from embomatrix.bench.peers.engine_pool import executed_twice, write_bundles
from embomatrix.bench.peers.page import contest_figures, contest_lines
from embomatrix.bench.peers.process_pool import process_pool
from embomatrix.bench.report.figures import BenchError
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import Dataset

PLANS = {"apple_to_counter": "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"}
SCENES = 2
PER_SCENE = 4
MEASURED = SCENES * (PER_SCENE - 1)
LIMIT_S = 60.0
SIZES = PeerSizes((PeerSystem.POOL,), chunk=2, warm=1, plain=2, alone=1, waves=1, wave=2, limit_s=LIMIT_S)

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = write_flats_dataset(tmp_path_factory.mktemp("dataset"), SCENES, PLANS)
    dataset = Dataset.load(folder)
    return main_work(dataset, write_workload(dataset, seed=0, bodies=60, scenes=SCENES, plans=PER_SCENE))


@pytest.fixture(scope="module")
def contest(work):
    return hold_contest(work, SIZES, lambda _: None)


def test_chunks_hold_one_scene_each_and_a_scene_stays_in_its_lane(work):
    chunks = chunks_of(work.rollouts, 3, lanes=2)
    assert sorted(rollout.rollout_id for chunk in chunks for rollout in chunk.rollouts) == sorted(
        rollout.rollout_id for rollout in work.rollouts
    )
    lanes = {(chunk.rollouts[0].bundle_digest, chunk.lane) for chunk in chunks}
    assert len(lanes) == SCENES
    assert all(len({rollout.bundle_digest for rollout in chunk.rollouts}) == 1 for chunk in chunks)
    assert [chunk.lane for chunk in chunks[:2]] == [0, 1]


def test_processes_of_a_pool_execute_what_a_simulator_of_ours_does(work, tmp_path):
    write_bundles(tmp_path, work.bundles)
    theirs = []
    setup = ContenderSetup(LibraryMode.SHARED, tmp_path, slots=1)
    with process_pool(setup) as contender:
        chunks = chunks_of(work.rollouts, 2, setup.lanes)
        contender.run(chunks, lambda news: theirs.extend(news.results), LIMIT_S)
    assert sorted(result.trace_digest for result in theirs) == sorted(traces(work))
    assert executed_twice(tmp_path) == 0


def traces(work):
    """The digest of what each plan of the work leads to."""
    for digest, data in work.bundles.items():
        bundle = decode_bundle(data)
        with contextlib.closing(load_simulator(bundle)) as simulator:
            for rollout in work.rollouts:
                if rollout.bundle_digest == digest:
                    yield simulator.execute(bundle.tasks[rollout.task_id], rollout.plan, rollout.seed).digest


@pytest.mark.slow
def test_a_contest_measures_ours_and_the_pool_on_all_of_the_work(contest):
    found = contest.peers[PeerSystem.POOL]
    assert len(contest.ours.all_at_once.latency_s) == MEASURED
    assert len(found.shared.all_at_once.latency_s) == MEASURED
    assert len(found.affine_cold.latency_s) + len(found.affine.latency_s) == SCENES * PER_SCENE
    assert found.affine_cold.loads == SCENES
    assert found.affine.loads == found.shared.all_at_once.loads == contest.ours.all_at_once.loads == 0
    assert len(found.plain.latency_s) == 2


@pytest.mark.slow
def test_a_killed_slot_costs_ours_nothing(contest):
    killed = contest.ours.killed
    assert (killed.lost, killed.hung) == (0, 0)
    assert len(killed.latency_s) == MEASURED


@pytest.mark.slow
def test_what_the_pool_gives_up_when_a_process_dies_is_counted(contest):
    killed = contest.peers[PeerSystem.POOL].shared.killed
    assert len(killed.latency_s) + killed.lost + killed.hung == MEASURED
    assert set(killed.reasons) <= {"BrokenProcessPool"}


@pytest.mark.slow
def test_ours_is_told_over_the_better_way_to_tune_a_peer(contest):
    figures = {figure.name: figure for figure in contest_figures(contest)}
    found = contest.peers[PeerSystem.POOL]
    best = max(found.shared.all_at_once.rate, found.affine.rate)
    assert figures["vs_process_pool"].value == pytest.approx(contest.ours.all_at_once.rate / best)
    assert "vs_ray" not in figures
    lines = contest_lines(tuple(figures.values()))
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| ours", "| process pool", "| ray", "| celery"]
    assert lines[4].endswith("not measured |")
    assert contest_lines(()) == []


def test_what_is_lost_and_what_never_comes_are_told_apart(work):
    chunks = singles(work.rollouts)
    contender = FakeContender({0: Lost(1, "Broken"), 1: None})
    outcome = execute(contender, chunks, LIMIT_S)
    assert (outcome.lost, outcome.hung) == (1, 1)
    assert outcome.reasons == {"Broken": 1}
    assert len(outcome.latency_s) == len(chunks) - 2


def test_processes_that_do_not_start_are_an_error_with_the_reason(tmp_path):
    setup = ContenderSetup(LibraryMode.SHARED, tmp_path, slots=2)
    with pytest.raises(BenchError, match=r"did not start within 0\.1 s: NoModule"):
        greet(FakeContender({0: Lost(0, "NoModule")}), setup, 0.1)
    with pytest.raises(BenchError, match="1 of 2 processes answered"):
        greet(FakeContender({}), setup, 0.1)


def test_a_greeting_has_no_rollouts():
    assert RolloutChunk(0, ()).requests == []


def test_what_is_measured_apart_comes_back_or_says_why_not():
    assert apart(divmod, (7, 2), LIMIT_S) == (3, 1)
    assert apart(divmod, (7, 0), LIMIT_S).startswith("ZeroDivisionError")
    assert apart(time.sleep, (60,), 0.5) == "it was not done within 0.5 s"
