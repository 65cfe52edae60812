"""Any sequence of any messages leaves a manager sound, and an honest run beside it complete."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from embomatrix.bench.adversary.inside import ADMIN, manager_inside
from embomatrix.bench.adversary.kinds import KINDS, AttackerRole
from embomatrix.bench.adversary.sequences import ROLLOUTS, play_seed
from embomatrix.bench.engine.workload import PINNED, load_workload
from embomatrix.proto.v1 import rollout_service_pb2, worker_service_pb2
from embomatrix.rpc.versions import PROTOCOL_VERSION

HOUR_S = 3600.0


@pytest.fixture(scope="module")
def workload():
    return load_workload(PINNED)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sequences")


def check(seed, steps, workload, folder):
    """Play a sequence. ``python -m embomatrix.bench.adversary.sequences SEED STEPS`` shows the steps of a failed one."""
    played = play_seed(seed, steps, workload, folder)
    assert played.tracebacks == [], (seed, played.steps)
    assert "INTERNAL" not in played.statuses, (seed, played.steps)
    assert (played.outcomes, played.fabricated) == (ROLLOUTS, 0), seed
    return played


def test_short_sequences_of_any_messages_break_nothing(workload, folder):
    seen = set()

    @settings(max_examples=10)
    @given(st.integers(0, 2**32))
    def play(seed):
        seen.update(step.split(": ")[0].partition(" ")[2] for step in check(seed, 80, workload, folder).steps)

    play()
    assert len(seen) > 100


@pytest.mark.slow
@pytest.mark.timeout(2 * HOUR_S)
def test_long_sequences_of_any_messages_break_nothing(workload, folder):
    for _ in range(400):
        check(random.randrange(2**32), 600, workload, folder)


def test_equal_seeds_play_equal_sequences(workload, tmp_path):
    first, second = (check(7, 60, workload, tmp_path / name).steps for name in ("a", "b"))
    assert first == second


async def test_manager_inside_answers_calls_of_every_shape(tmp_path):
    async with manager_inside(tmp_path) as manager:
        opening = rollout_service_pb2.OpenRunRequest(run_id="r1", protocol_version=PROTOCOL_VERSION)
        data = opening.SerializeToString()
        assert (await manager.call("RolloutService/OpenRun", "", [data]))[0] == "UNAUTHENTICATED"
        status, answers = await manager.call("RolloutService/OpenRun", ADMIN, [data])
        assert (status, rollout_service_pb2.OpenRunResponse.FromString(answers[0]).run_id) == ("OK", "r1")
        assert (await manager.call("SceneService/PutBundle", ADMIN, []))[0] == "INVALID_ARGUMENT"
        assert (await manager.call("SceneService/GetBundle", ADMIN, [b""]))[0] == "INVALID_ARGUMENT"
        beat = worker_service_pb2.SessionRequest(session_id="none").SerializeToString()
        assert (await manager.call("WorkerService/Session", ADMIN, [beat]))[0] == "INVALID_ARGUMENT"
        assert manager.tracebacks == []


async def test_unexpected_error_inside_the_manager_is_a_traceback(tmp_path):
    async with manager_inside(tmp_path) as manager:
        manager.runtime.history = None
        status, _ = await manager.call("AdminService/GetRun", ADMIN, [b""])
        assert status == "INTERNAL"
        assert "AttributeError" in manager.tracebacks[0]


def test_hostile_workers_know_calls_and_messages_within_a_session():
    methods = {kind.method for kind in KINDS.values() if kind.actor is AttackerRole.WORKER}
    assert methods == {
        f"WorkerService/{name}" for name in ("Register", "Session", "Heartbeat", "FetchBundle", "Deregister")
    }
