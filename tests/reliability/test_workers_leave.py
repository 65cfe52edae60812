"""A9 and A11: two workers of one name, and workers that drain during work."""

import asyncio
import signal
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
    until,
)

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


async def test_older_of_two_workers_with_one_name_stops(tmp_path):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 60, "slow")
            running = asyncio.create_task(outcomes(client, batch))
            await until(lambda: cluster.executed())
            cluster.processes["older"] = cluster.processes.pop("w1")
            began_s = time.monotonic()
            cluster.start_worker("w1")
            both = [cluster.processes[name] for name in ("older", "w1")]
            await until(lambda: any(process.poll() is not None for process in both))
            settled_s = time.monotonic() - began_s
            results = await running
            stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        print_figures("A9", counted, settled_s=settled_s, stale=stats.stale_results)
        assert (counted.delivered, counted.duplicates, counted.fabricated) == (60, 0, 0)
        assert "another session of worker w1 took over" in cluster.log("w1")
        assert "another worker of that name is running" in cluster.log("w1")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_draining_worker_finishes_its_leases(tmp_path, number):
    async with two_workers(tmp_path) as (cluster, client):
        batch = batch_of(await opened(client), 40, "slow")
        running = asyncio.create_task(outcomes(client, batch))
        await until(lambda: len(cluster.executed()) >= 8)
        process = cluster.processes["w1"]
        cluster.signal("w1", number)
        began_s = time.monotonic()
        status = await asyncio.to_thread(process.wait, 60)
        left_s = time.monotonic() - began_s
        results = await running
        stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        print_figures(f"A11 {number.name}", counted, left_s=left_s, redispatched=stats.redispatched)
        assert counted.clean
        assert status == 0
        assert stats.redispatched == 0
        assert set(cluster.executed().values()) == {1}
        assert {result.attempt for result in results} == {1}


async def test_second_signal_ends_a_worker_at_once(tmp_path):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 8, "first hangs")
            running = asyncio.create_task(outcomes(client, batch))
            await until(lambda: len(cluster.executed()) >= 2)
            process = cluster.processes["w1"]
            cluster.signal("w1", signal.SIGINT)
            await asyncio.sleep(1.0)
            assert process.poll() is None, "it drains: its rollouts hang"
            cluster.signal("w1", signal.SIGINT)
            began_s = time.monotonic()
            await asyncio.to_thread(process.wait, 60)
            left_s = time.monotonic() - began_s
            cluster.start_worker("w2", slots=4)
            await until(lambda: len(cluster.executed()) >= 4)
            running.cancel()
        print(f"\nA11 SIGINT twice: left_s={left_s:.2f}")
        assert left_s < 30
