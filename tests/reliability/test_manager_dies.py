"""A4: the manager is killed during a batch. No result is lost or duplicated, and live rollouts are not repeated."""

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

pytestmark = pytest.mark.timeout(240)


async def killed_in_the_middle(folder, *, count, task, kill_at, away_s, grace_s):
    """A manager killed after ``kill_at`` results and started again ``away_s`` later."""
    async with two_workers(folder, restart_grace_s=grace_s) as (cluster, client):
        batch = batch_of(await opened(client), count, task)
        times = {}

        def kill(seen):
            times.setdefault(seen, time.monotonic())
            if seen == kill_at:
                cluster.signal("manager")

        running = asyncio.create_task(outcomes(client, batch, then=kill))
        await until(lambda: "manager" not in cluster.processes or running.done())
        await asyncio.sleep(away_s)
        began_s, wall_s = time.monotonic(), time.time()
        cluster.start_manager()
        await connected(client, "w1", "w2")
        results = await running
        stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        again = sum(times - 1 for times in cluster.executed().values())
        serves_s = cluster.logged_s("manager", "leading under epoch", wall_s)
        joined_s = max(
            cluster.logged_s("manager", f"registered worker={name}", wall_s) for name in ("w1", "w2")
        )
        recovery_s = min(at_s for at_s in times.values() if at_s > began_s) - began_s
        figures = {"executed_again": again, "start_s": serves_s - wall_s, "rejoin_s": joined_s - serves_s}
        print_figures(f"A4 away {away_s:g} s", counted, **figures, first_result_s=recovery_s)
        assert counted.clean
        assert again == 0
        assert stats.delivered == count


async def test_killed_manager_resumes_without_repeating_live_rollouts(tmp_path):
    # As many rollouts as the two workers hold: none has to wait for the end of the grace time.
    await killed_in_the_middle(tmp_path, count=10, task="slow", kill_at=2, away_s=0.1, grace_s=15.0)


@pytest.mark.slow
async def test_restarted_manager_receives_results_finished_meanwhile(tmp_path):
    await killed_in_the_middle(tmp_path, count=400, task="brief", kill_at=100, away_s=5.0, grace_s=8.0)


@pytest.mark.slow
async def test_batch_continues_without_its_trainer(tmp_path):
    with RealCluster(tmp_path, restart_grace_s=0.5) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 12, "brief")
            asking = asyncio.create_task(outcomes(client, batch))
            await until(lambda: cluster.executed())
            asking.cancel()
            cluster.signal("manager")
            cluster.start_manager()
            await connected(client, "w1")
            async with asyncio.timeout(30):
                while (await client.list_runs())[0].stats.delivered < 12:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
            results = await outcomes(client, batch)
        counted = tally(batch, results)
        print_figures("A4 without its trainer", counted, executed=sum(cluster.executed().values()))
        assert counted.clean


async def test_suspended_manager_loses_no_worker(tmp_path):
    async with two_workers(tmp_path, lost_after_s=2.0) as (cluster, client):
        batch = batch_of(await opened(client), 40, "slow")
        running = asyncio.create_task(outcomes(client, batch))
        await until(lambda: len(cluster.executed()) >= 4)
        cluster.signal("manager", signal.SIGSTOP)
        await asyncio.sleep(5.0)
        cluster.signal("manager", signal.SIGCONT)
        results = await running
        stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        print_figures("A4 stands still 5 s", counted, redispatched=stats.redispatched)
        assert counted.clean
        # Leases sent over a broken connection never reached a worker and are re-dispatched.
        assert set(cluster.executed().values()) == {1}
        assert {result.attempt for result in results} == {1}
        assert "worker lost" not in cluster.log("manager")
