"""Leases ahead in a slot's stream run without the daemon, and a failing process loses none of them."""

import asyncio
import itertools
import math
import random
import time
from collections import Counter

import pytest
from tests.fakes.leases import lease_to_proto
from tests.integration.worker.test_slots import running

from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.session import lease_from_proto
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    ResidentState,
    Rollout,
)
from embomatrix.worker.slots.execution import AHEAD_S, RECENT

pytestmark = pytest.mark.timeout(60)
BRIEF_S = AHEAD_S / 12
"""Execution time at which a slot's stream may hold twelve leases ahead."""


@pytest.fixture
def executions(tmp_path, monkeypatch):
    """Return a function that counts the starts of each rollout, by id."""
    path = tmp_path / "executions"
    monkeypatch.setenv("FAKE_EXECUTIONS", str(path))
    return lambda: Counter(path.read_text().split())


def submit(harness, lease_id, task="ok", deadline_s=30.0, digest="scene"):
    """Submit a lease with the rollout's message, as the manager sends it."""
    lease = Lease(LeaseRef(lease_id, 1), Rollout(lease_id, "g", digest, task, (), 1), deadline_s)
    lease = lease_from_proto(lease_to_proto(lease))
    harness.pool.submit(lease)
    return lease.ref


async def learn_pace(harness):
    """Execute brief rollouts until the slot gets leases ahead; returns how many that took.

    A busy machine may slow down a brief execution.
    """
    pace_s, count = math.inf, 0
    while count < 4 or pace_s > BRIEF_S:
        lease_id, count = f"early{count}", count + 1
        submit(harness, lease_id)
        execute_s = (await harness.outcomes(count))[lease_id].timings.execute_s
        pace_s = execute_s if count == 1 else pace_s + RECENT * (execute_s - pace_s)
    harness.results.clear()
    return count


async def test_slot_continues_while_the_daemon_is_busy(tmp_path, executions):
    async with running(tmp_path, slots=1) as harness:
        early = await learn_pace(harness)
        for number in range(12):
            submit(harness, f"l{number}", "brief")
        await harness.until(lambda: len(harness.results) >= 1)
        before = len(harness.results)
        ends_s = time.monotonic() + 20.0
        while sum(executions().values()) - early < before + 3:
            assert time.monotonic() < ends_s, "one that runs, and more"
            time.sleep(0.01)  # noqa: ASYNC251  # nothing of the daemon runs meanwhile
        outcomes = await harness.outcomes(12)
    assert all(isinstance(outcome, Completed) for outcome in outcomes.values())
    assert set(executions().values()) == {1}


@pytest.mark.parametrize(
    ("task", "code"),
    [
        ("crash", InfraCode.SLOT_CRASHED),
        ("raise", InfraCode.SLOT_CRASHED),
        ("greedy", InfraCode.SLOT_OOM),
        ("hang", InfraCode.SLOT_TIMEOUT),
    ],
)
async def test_failed_rollout_does_not_affect_leases_behind_it(tmp_path, executions, task, code):
    async with running(tmp_path, slots=1) as harness:
        await learn_pace(harness)
        for number in range(4):
            submit(harness, f"before{number}")
        submit(harness, "bad", task, deadline_s=1.0)
        for number in range(8):
            submit(harness, f"behind{number}")
        outcomes = await harness.outcomes(13)
    assert outcomes.pop("bad").code is code
    assert all(isinstance(outcome, Completed) for outcome in outcomes.values())
    assert set(executions().values()) == {1}, "each was begun once: none of those behind it had been lost"
    processes = {name: outcome.final[0].split()[3] for name, outcome in outcomes.items()}
    before, behind = (
        {pid for name, pid in processes.items() if name.startswith(word)} for word in ("before", "behind")
    )
    assert before.isdisjoint(behind), "a damaged process executes nothing more"


async def test_lease_cancelled_in_a_stream_gives_no_result_and_kills_nothing(tmp_path, executions):
    async with running(tmp_path, slots=1) as harness:
        await learn_pace(harness)
        submit(harness, "first", "slow")
        refs = [submit(harness, f"l{number}") for number in range(6)]
        await harness.until(lambda: executions()["first"])
        harness.pool.cancel(refs[1:3])
        outcomes = await harness.outcomes(5)
        assert harness.pool.held() == ()
    assert set(outcomes) == {"first", "l0", "l3", "l4", "l5"}
    assert all(isinstance(outcome, Completed) for outcome in outcomes.values())


async def test_leases_behind_a_cancelled_rollout_are_executed_elsewhere(tmp_path, executions):
    async with running(tmp_path, slots=1) as harness:
        await learn_pace(harness)
        stuck = submit(harness, "stuck", "hang")
        for number in range(4):
            submit(harness, f"l{number}")
        await harness.until(lambda: executions()["stuck"])
        harness.pool.cancel([stuck])
        outcomes = await harness.outcomes(4)
    assert set(outcomes) == {f"l{number}" for number in range(4)}
    assert set(executions().values()) == {1}


async def test_lease_of_another_scene_is_executed_despite_endless_leases_of_a_busy_scene(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        harness.pool.want(["scene", "other"])
        await harness.until(lambda: harness.state("scene") is harness.state("other") is ResidentState.WARM)
        await learn_pace(harness)
        names = (f"l{number}" for number in itertools.count())
        for name in itertools.islice(names, 8):
            submit(harness, name, "short")
        submit(harness, "other", digest="other")
        while "other" not in {result.ref.lease_id for result in harness.results}:
            for name in itertools.islice(names, max(0, 20 - len(harness.pool.held()))):
                submit(harness, name, "short")
            await asyncio.sleep(0.002)


async def test_lease_repeated_after_a_cancellation_has_one_result(tmp_path):
    async with running(tmp_path, slots=1) as harness:
        await learn_pace(harness)
        submit(harness, "first", "slow")
        ref = submit(harness, "again")
        for number in range(4):
            submit(harness, f"l{number}")
        await asyncio.sleep(0.1)
        harness.pool.cancel([ref])
        submit(harness, "again")
        await harness.outcomes(6)
        await asyncio.sleep(0.1)
        assert len(harness.results) == 6


@pytest.mark.parametrize("seed", [1, 2])
async def test_every_lease_that_is_not_cancelled_has_one_result(tmp_path, executions, seed):
    rng = random.Random(seed)
    kinds = {"ok": 12, "brief": 2, "crash": 1, "raise": 1, "hang": 1}
    tasks = dict(enumerate(rng.choices(list(kinds), list(kinds.values()), k=50)))
    cancelled = set()
    async with running(tmp_path, slots=2) as harness:
        await learn_pace(harness)
        for number, task in tasks.items():
            ref = submit(harness, str(number), task, deadline_s=0.5 if task == "hang" else 30.0)
            if rng.random() < 0.3:
                await asyncio.sleep(rng.random() * 0.02)
            if rng.random() < 0.1 and ref in harness.pool.held():
                harness.pool.cancel([ref])
                cancelled.add(number)
        await harness.until(lambda: not harness.pool.held(), limit_s=45.0)
    results = Counter(result.ref.lease_id for result in harness.results)
    assert results == Counter(str(number) for number in tasks if number not in cancelled)
    failed = {
        int(result.ref.lease_id) for result in harness.results if not isinstance(result.outcome, Completed)
    }
    bad = {number for number, task in tasks.items() if task in ("crash", "raise", "hang")}
    assert failed == bad - cancelled
    finished = [str(number) for number in tasks if number not in bad | cancelled]
    kills = 1 + len(cancelled)
    begun = executions()
    assert all(begun[name] <= kills for name in finished), "only what is called off costs others their work"
