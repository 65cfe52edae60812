"""A5: Redis stops or is killed during a batch, and outcomes stay the same."""

import asyncio
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
from tests.fakes.redis_server import RedisServer
from tests.fakes.simulation import graded_total

from embomatrix.cli.local_cluster import free_port

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


@pytest.mark.parametrize("end", ["stop", "kill"])
@pytest.mark.parametrize("away_s", [1.0, 10.0])
async def test_dispatch_resumes_after_a_redis_outage_with_equal_outcomes(tmp_path, end, away_s):
    with RedisServer(tmp_path / "redis", free_port()) as redis:
        async with two_workers(tmp_path, state=redis.url, leader_ttl_s=3.0) as (_, client):
            run_id = await opened(client)
            times = []
            quiet = await outcomes(client, batch_of(run_id, 200, "graded", "quiet"))
            # The same rollouts under another batch; its ids name the same plans.
            batch = batch_of(run_id, 2000, "graded", "quiet-again")
            running = asyncio.create_task(
                outcomes(client, batch, then=lambda _: times.append(time.monotonic()))
            )
            await until(lambda: len(times) >= 200)
            await asyncio.to_thread(getattr(redis, end))
            await asyncio.sleep(away_s)
            await asyncio.to_thread(redis.start)
            back_s = time.monotonic()
            results = await running
            later = await outcomes(client, batch_of(run_id, 20, "graded", "later"))
            counted = tally(batch, results, graded_total)
            recovery_s = min(at_s for at_s in times if at_s > back_s) - back_s
            print_figures(f"A5 {end} {away_s:g} s", counted, recovery_s=recovery_s)
            assert counted.clean
            assert tally(batch_of(run_id, 200, "graded", "quiet"), quiet, graded_total).clean
            assert len(later) == 20
            assert recovery_s < 20


async def test_results_lost_by_redis_are_redelivered_once(tmp_path):
    with (
        RedisServer(tmp_path / "redis", free_port()) as redis,
        RealCluster(tmp_path, state=redis.url, leader_ttl_s=2.0, restart_grace_s=8.0) as cluster,
    ):
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 300, "brief")
            seen = []
            running = asyncio.create_task(outcomes(client, batch, then=seen.append))
            await until(lambda: len(seen) >= 60)
            await asyncio.to_thread(redis.kill)
            await asyncio.to_thread(redis.forget, 8_000)
            await asyncio.to_thread(redis.start)
            await until(lambda: len(seen) >= 160)
            # The present manager still knows the results that Redis lost; the next one does not.
            cluster.signal("manager")
            cluster.start_manager()
            await connected(client, "w1")
            results = await running
            again = await outcomes(client, batch)
        counted = tally(batch, results)
        print_figures("A5 last second lost", counted, executed=sum(cluster.executed().values()))
        assert counted.clean
        assert tally(batch, again).clean
        assert sum(cluster.executed().values()) > 300, "nothing was lost: the test shows nothing"
