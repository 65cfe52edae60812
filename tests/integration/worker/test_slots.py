"""Slots: every lease ends in one result, even if simulator processes fail."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from tests.fakes import waiting
from tests.fakes.simulation import PROGRAM

from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    InfraFailure,
    ResidentState,
    Rollout,
)
from embomatrix.worker.slots.pool import SlotPool
from embomatrix.worker.slots.processes import ProcessGoneError
from embomatrix.worker.slots.residents import LoadError, SlotLimits


class Harness:
    """Pool whose bundle files script the behaviour of their scenes."""

    def __init__(self, folder, *, slots=2, memory_mb=500.0, program=PROGRAM, fork_s=10.0):
        self.folder = folder
        self.results = []
        self.fetched = []
        self.pool = SlotPool(
            SlotLimits(slots, memory_mb, slot_memory_mb=256, fork_s=fork_s),
            bundle_path=self._path,
            on_result=self.results.append,
            on_change=lambda: None,
            log=folder / "simulator.log",
            program=program,
        )

    async def _path(self, digest):
        self.fetched.append(digest)
        if digest == "unfetchable":
            raise LoadError(InfraCode.BUNDLE_CORRUPT, "fetched twice and damaged twice")
        path = self.folder / digest
        path.write_text(digest.split("-")[0])
        return path

    def submit(self, lease_id, task="ok", digest="scene", deadline_s=10.0):
        rollout = Rollout(lease_id, "g", digest, task, (), 1)
        lease = Lease(LeaseRef(lease_id, 1), rollout, deadline_s)
        self.pool.submit(lease)
        return lease

    async def until(self, condition, limit_s=15.0):
        await waiting.until(condition, limit_s)

    async def outcomes(self, count):
        await self.until(lambda: len(self.results) >= count)
        return {result.ref.lease_id: result.outcome for result in self.results}

    def state(self, digest):
        return next(
            (resident.state for resident in self.pool.residents() if resident.bundle_digest == digest), None
        )


@contextlib.asynccontextmanager
async def running(folder, **options):
    harness = Harness(folder, **options)
    await harness.pool.start()
    task = asyncio.create_task(harness.pool.run())
    try:
        yield harness
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def _living():
    return [process for process in _simulators() if process.status() != psutil.STATUS_ZOMBIE]


def _simulators(parent=None):
    below = psutil.Process(parent or os.getpid()).children(recursive=True)
    # Other children of this process, such as a pool's resource tracker, do not belong to the slots.
    return [process for process in below if _is_simulator(process)]


def _is_simulator(process):
    try:
        return set(PROGRAM[1:]) <= set(process.cmdline()) or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


async def test_lease_is_executed_and_scored_in_another_process(tmp_path):
    async with running(tmp_path) as harness:
        harness.submit("l1")
        outcome = (await harness.outcomes(1))["l1"]
    assert isinstance(outcome, Completed)
    assert outcome.reward.total == 30.5
    assert outcome.trace_digest == "trace of l1"
    assert str(os.getpid()) not in outcome.final[0]
    assert not outcome.warm
    assert outcome.timings.load_s > 0


async def test_desired_scene_is_warm_before_its_first_lease(tmp_path):
    async with running(tmp_path) as harness:
        harness.pool.want(["a", "b"])
        await harness.until(lambda: harness.state("a") is harness.state("b") is ResidentState.WARM)
        harness.submit("l1", digest="b")
        outcome = (await harness.outcomes(1))["l1"]
    assert outcome.warm
    assert outcome.timings.load_s == 0.0


async def test_slot_is_reused_for_the_next_lease_of_its_scene(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        for number in range(5):
            harness.submit(f"l{number}")
        outcomes = await harness.outcomes(5)
    assert [outcome.final[0].split(" in ")[0] for outcome in outcomes.values()] == [
        f"executed {number}" for number in range(1, 6)
    ]


async def test_results_read_together_have_their_own_execution_times(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        began_s = time.monotonic()
        for number in range(40):
            harness.submit(f"l{number}")
        await harness.outcomes(40)
        took_s = time.monotonic() - began_s
    assert all(result.held_s == result.outcome.timings.execute_s for result in harness.results)
    assert sum(result.held_s for result in harness.results) <= took_s


async def test_idle_processes_are_bounded_over_all_scenes(tmp_path):
    limits = SlotLimits(slots=1, memory_mb=128)
    assert limits.idle_slots == 4
    async with running(tmp_path, slots=limits.slots, memory_mb=limits.memory_mb) as harness:
        for number in range(8):
            harness.submit(f"l{number}", digest=f"scene-{number}")
            await harness.outcomes(number + 1)
        root_and_scenes = 1 + 8
        await harness.until(lambda: len(_living()) <= root_and_scenes + limits.idle_slots)
        harness.submit("again", digest="scene-0")
        assert isinstance((await harness.outcomes(9))["again"], Completed)


async def test_slot_with_memory_growth_is_replaced(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        for number, task in enumerate(("ok", "grow", "ok")):
            harness.submit(f"l{number}", task)
        before, grown, after = (outcome.final[0] for outcome in (await harness.outcomes(3)).values())
    assert (before.split(" in ")[0], grown.split(" in ")[0]) == ("executed 1", "executed 2")
    assert after.startswith("executed 1 ")


async def test_two_slots_execute_one_scene_at_the_same_time(tmp_path):
    async with running(tmp_path, slots=2) as harness:
        harness.pool.want(["scene"])
        await harness.until(lambda: harness.state("scene") is ResidentState.WARM)
        harness.submit("l1", f"meet {tmp_path}")
        harness.submit("l2", f"meet {tmp_path}")
        outcomes = await harness.outcomes(2)
    assert all(isinstance(outcome, Completed) for outcome in outcomes.values())


async def test_duplicate_lease_is_executed_once(tmp_path):
    async with running(tmp_path) as harness:
        harness.submit("l1", "slow")
        harness.submit("l1", "slow")
        harness.submit("l2")
        await harness.outcomes(2)
        await asyncio.sleep(0.4)
        assert sorted(result.ref.lease_id for result in harness.results) == ["l1", "l2"]


async def test_crash_costs_one_rollout_and_the_next_gets_a_new_slot(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.submit("l1", "crash")
        harness.submit("l2")
        outcomes = await harness.outcomes(2)
    assert outcomes["l1"] == InfraFailure(
        InfraCode.SLOT_CRASHED, "the simulator ended during the rollout: killed by SIGSEGV"
    )
    assert isinstance(outcomes["l2"], Completed)
    assert harness.fetched == ["scene"]


async def test_hanging_rollout_is_killed_at_its_deadline_without_affecting_others(tmp_path):
    async with running(tmp_path, slots=2) as harness:
        harness.submit("stuck", "hang", deadline_s=0.4)
        for number in range(20):
            harness.submit(f"l{number}")
        outcomes = await harness.outcomes(21)
    assert outcomes["stuck"].code is InfraCode.SLOT_TIMEOUT
    assert "longer than its 0.4 s" in outcomes["stuck"].message
    assert all(isinstance(outcome, Completed) for name, outcome in outcomes.items() if name != "stuck")


async def test_exception_during_a_rollout_is_an_infrastructure_failure(tmp_path):
    async with running(tmp_path) as harness:
        harness.submit("l1", "raise")
        outcome = (await harness.outcomes(1))["l1"]
    assert outcome.code is InfraCode.SLOT_CRASHED
    assert outcome.message.startswith("ArithmeticError: xxx")
    assert len(outcome.message) == 500


async def test_out_of_memory_rollout_fails_alone(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.submit("l1", "greedy")
        harness.submit("l2")
        outcomes = await harness.outcomes(2)
    assert outcomes["l1"].message.startswith("MemoryError")
    assert outcomes["l1"].code is InfraCode.SLOT_OOM
    assert isinstance(outcomes["l2"], Completed)


async def test_scene_whose_process_died_is_loaded_again(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.submit("l1", "orphan")
        harness.submit("l2")
        outcomes = await harness.outcomes(2)
    assert outcomes["l1"].code is InfraCode.SLOT_CRASHED
    assert isinstance(outcomes["l2"], Completed)
    assert harness.fetched == ["scene", "scene"]


async def test_stopped_scene_process_is_replaced_while_its_rollout_continues(tmp_path):
    async with running(tmp_path, slots=2, fork_s=0.3) as harness:
        harness.submit("other", digest="other")
        await harness.outcomes(1)
        harness.submit("running", "stop")  # its slot stops the scene's process and continues for a second
        [root] = [child for child in psutil.Process().children() if _is_simulator(child)]
        await harness.until(lambda: any(scene.status() == psutil.STATUS_STOPPED for scene in root.children()))
        [stopped] = [scene for scene in root.children() if scene.status() == psutil.STATUS_STOPPED]
        harness.submit("next")
        outcomes = await harness.outcomes(2)
        assert isinstance(outcomes["next"], Completed)
        assert stopped.is_running()  # the other rollout's slot would die with it
        outcomes = await harness.outcomes(3)
        assert isinstance(outcomes["running"], Completed)
        await harness.until(lambda: not stopped.is_running())
        assert harness.fetched == ["other", "scene", "scene"]


async def test_killed_root_is_restarted(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.submit("l1")
        await harness.outcomes(1)
        [root] = [child for child in psutil.Process().children() if _is_simulator(child)]
        root.kill()
        root.wait(5)
        harness.submit("l2", digest="other")
        outcomes = await harness.outcomes(2)
    assert isinstance(outcomes["l2"], Completed)


@pytest.mark.parametrize(
    ("digest", "code", "text"),
    [
        ("corrupt", InfraCode.BUNDLE_CORRUPT, "not what its digest says"),
        ("impossible", InfraCode.SCENE_LOAD_FAILED, "a table without legs"),
        ("crash", InfraCode.SCENE_LOAD_FAILED, "killed by SIGSEGV"),
        ("huge", InfraCode.SCENE_LOAD_FAILED, "the scene takes more than"),
        ("unfetchable", InfraCode.BUNDLE_CORRUPT, "damaged twice"),
    ],
)
async def test_unloadable_scene_fails_its_leases_with_the_reason(tmp_path, digest, code, text):
    async with running(tmp_path) as harness:
        harness.submit("l1", digest=digest)
        harness.submit("l2")
        outcomes = await harness.outcomes(2)
        assert harness.state(digest) is ResidentState.FAILED or harness.state(digest) is None
    assert outcomes["l1"].code is code
    assert text in outcomes["l1"].message
    assert isinstance(outcomes["l2"], Completed)


async def test_unwanted_scenes_are_evicted_if_memory_is_short(tmp_path):
    async with running(tmp_path, memory_mb=100.0) as harness:
        harness.pool.want(["large-1"])
        await harness.until(lambda: harness.state("large-1") is ResidentState.WARM)
        harness.pool.want(["large-2"])
        await harness.until(lambda: harness.state("large-2") is ResidentState.WARM)
        harness.pool.want(["large-3"])
        await harness.until(lambda: harness.state("large-3") is ResidentState.WARM)
        assert harness.state("large-1") is None
        assert harness.pool.memory_used_mb <= 100.0


async def test_cancelled_lease_gives_no_result_and_frees_its_slot(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        stuck = harness.submit("stuck", "hang", deadline_s=60.0)
        waiting = harness.submit("waiting", "hang", deadline_s=60.0)
        harness.submit("l1")
        await harness.until(lambda: harness.pool.load == 1.0)
        harness.pool.cancel([stuck.ref, waiting.ref])
        assert list(await harness.outcomes(1)) == ["l1"]
        assert harness.pool.held() == ()


async def test_cancelling_right_after_the_start_does_not_lose_the_slot(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.pool.want(["scene"])
        await harness.until(lambda: harness.state("scene") is ResidentState.WARM)
        for number in range(30):
            lease = harness.submit(f"c{number}")
            for _ in range(number % 4):
                await asyncio.sleep(0)
            harness.pool.cancel([lease.ref])
        harness.submit("last")
        await harness.until(lambda: any(result.ref.lease_id == "last" for result in harness.results))


async def test_simulator_that_cannot_start_reports_the_reason(tmp_path):
    harness = Harness(tmp_path, program=("env", "FAKE_SIMULATION=broken", *PROGRAM))
    with pytest.raises(ProcessGoneError, match="the engine is missing: install it"):
        await harness.pool.start()


async def test_no_process_outlives_the_pool(tmp_path):
    async with running(tmp_path) as harness:
        harness.submit("l1")
        await harness.outcomes(1)
        processes = _simulators()
        assert len(processes) >= 3
    assert psutil.wait_procs(processes, timeout=5)[1] == []


def test_no_process_outlives_a_daemon_that_was_killed(tmp_path):
    program = (
        "import asyncio, pathlib, sys\n"
        "from tests.integration.worker.test_slots import running\n"
        "async def main():\n"
        "    async with running(pathlib.Path(sys.argv[1])) as harness:\n"
        "        harness.submit('l1', 'hang', deadline_s=600)\n"
        "        await harness.until(lambda: harness.pool.load > 0)\n"
        "        await asyncio.sleep(0.3)\n"
        "        print('up', flush=True)\n"
        "        await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    root = next(parent for parent in Path(__file__).parents if (parent / "pyproject.toml").exists())
    daemon = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, cwd=root
    )
    assert daemon.stdout.readline() == b"up\n"
    processes = _simulators(daemon.pid)
    assert len(processes) >= 3
    daemon.send_signal(signal.SIGKILL)
    daemon.wait()
    daemon.stdout.close()
    assert psutil.wait_procs(processes, timeout=5)[1] == []


def test_forked_processes_have_imported_neither_grpc_nor_pydantic():
    check = (
        "import sys, embomatrix.worker.slots.slot_program, threading\n"
        "print([name for name in ('grpc', 'pydantic', 'torch', 'fastapi') if name in sys.modules], threading.active_count())"
    )
    result = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout == "[] 1\n"
