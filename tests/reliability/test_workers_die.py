"""A1 and A2: runs without faults, and runs with repeatedly killed workers."""

import asyncio
import contextlib
import random
import time

import pytest
from tests.fakes.real_cluster import (
    RealCluster,
    batch_of,
    connected,
    opened,
    outcomes,
    print_figures,
    tally,
    two_workers,
)
from tests.fakes.worker import completed

from embomatrix.rpc.wire.values import Completed

pytestmark = pytest.mark.timeout(900)

WORKERS = 10
ROLLOUTS = 20_000


async def test_fault_free_runs_repeat_hardly_any_rollout(tmp_path):
    batches, size = 20, 43
    async with two_workers(tmp_path) as (cluster, client):
        run_id = await opened(client)
        for number in range(batches):
            # At the end of each batch, one worker has free slots while leases still wait at the other.
            batch = batch_of(run_id, size, "short", batch_id=f"b{number}")
            counted = tally(batch, await outcomes(client, batch))
            assert counted.clean
        again = sum(times - 1 for times in cluster.executed().values())
        print_figures("A1 short batches", counted, batches=batches, executed_again=again)
        # A machine that stops a worker for some time makes its leases late.
        assert again <= batches // 4


async def kill_again_and_again(cluster, rng, kills):
    """Kill a random worker with SIGKILL every two seconds and restart it after varying delays."""
    with contextlib.suppress(asyncio.CancelledError):
        while True:
            await asyncio.sleep(2.0)
            name = rng.choice([name for name in cluster.processes if name != "manager"])
            kills.append((name, cluster.signal(name)))
            cluster.start_quick_worker(name)


async def soak(folder, *, killing):
    """Run 20,000 rollouts on ten workers, with or without kills; returns the tally, the seconds and the detections."""
    with RealCluster(folder) as cluster:
        cluster.start_manager()
        names = [f"w{number}" for number in range(WORKERS)]
        async with cluster.client() as client:
            await connected(client)
            for name in names:
                cluster.start_quick_worker(name)
            await connected(client, *names)
            batch = batch_of(await opened(client), ROLLOUTS)
            kills = []
            killer = asyncio.create_task(
                kill_again_and_again(cluster, random.Random(0), kills) if killing else asyncio.sleep(0)
            )
            began_s = time.monotonic()
            results = await outcomes(client, batch, deadline_s=800.0)
            took_s = time.monotonic() - began_s
            killer.cancel()
            await asyncio.gather(killer, return_exceptions=True)
            stats = await client.close_run(batch.run_id)
        found = [
            at_s - killed_s
            for name, killed_s in kills
            if (at_s := cluster.logged_s("manager", f"worker (lost|registered) worker={name}\\b", killed_s))
        ]
    return tally(batch, results, completed().reward.total), stats, took_s, kills, found


@pytest.mark.slow
async def test_twenty_thousand_rollouts_have_one_outcome_each_while_workers_are_killed(tmp_path):
    (tmp_path / "quiet").mkdir()
    (tmp_path / "killing").mkdir()
    counted, _, quiet_s, _, _ = await soak(tmp_path / "quiet", killing=False)
    print_figures("A1", counted, seconds=quiet_s, per_second=ROLLOUTS / quiet_s)
    assert counted.clean
    counted, stats, took_s, kills, found = await soak(tmp_path / "killing", killing=True)
    print_figures(
        "A2",
        counted,
        kills=len(kills),
        redispatched=stats.redispatched,
        slowest_detection_s=max(found),
        seconds=took_s,
        throughput_ratio=quiet_s / took_s,
    )
    assert (counted.delivered, counted.duplicates, counted.fabricated) == (ROLLOUTS, 0, 0)
    assert len(kills) >= 3
    assert stats.delivered == ROLLOUTS


@pytest.mark.slow
async def test_repeatedly_killed_daemons_lose_no_rollout(tmp_path):
    with RealCluster(tmp_path, max_attempts=10) as cluster:
        cluster.start_manager()
        for name in ("w1", "w2", "w3"):
            cluster.start_worker(name)
        async with cluster.client() as client:
            await connected(client, "w1", "w2", "w3")
            batch = batch_of(await opened(client), 300, "brief")
            rng = random.Random(1)
            kills = []

            def kill(seen):
                if seen % 60 == 0:
                    name = rng.choice(["w1", "w2", "w3"])
                    kills.append(cluster.signal(name))
                    cluster.start_worker(name)

            results = await outcomes(client, batch, then=kill)
            stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        print_figures("A2 daemons", counted, kills=len(kills), redispatched=stats.redispatched)
        assert counted.clean
        assert all(isinstance(result.outcome, Completed) for result in results)
