"""A6: network partitions between worker and manager, in one or both directions."""

import asyncio
import re
import time

import pytest
from tests.fakes.proxy import TO_MANAGER, TO_WORKER, Proxy
from tests.fakes.real_cluster import (
    RealCluster,
    batch_of,
    connected,
    opened,
    outcomes,
    print_figures,
    tally,
    until,
)

pytestmark = pytest.mark.timeout(300)

DIRECTIONS = pytest.mark.parametrize(
    "directions", [(TO_MANAGER,), (TO_WORKER,), (TO_MANAGER, TO_WORKER)], ids=["to", "from", "both"]
)


async def cut_while_it_runs(cluster, directions, *, count, task, cut_s, other):
    """Cut one worker's line for ``cut_s`` during its work; ``other`` joins directly meanwhile. Returns the outcome."""
    cluster.start_manager()
    async with Proxy(cluster.ports["manager"]) as proxy, cluster.client() as client:
        cluster.start_worker("w1", manager=proxy.address)
        await connected(client, "w1")
        batch = batch_of(await opened(client), count, task)
        running = asyncio.create_task(outcomes(client, batch, deadline_s=200.0))
        await until(lambda: cluster.executed())
        cut_at_s = time.time()
        proxy.cut(*directions)
        if other:
            cluster.start_worker(other)
        await asyncio.sleep(cut_s)
        proxy.heal()
        results = await running
        await connected(client, "w1")
        await asyncio.sleep(1.0)
        stats = await client.close_run(batch.run_id)
        lost_s = cluster.logged_s("manager", "worker lost worker=w1", cut_at_s)
    return tally(batch, results), stats, None if lost_s is None else lost_s - cut_at_s


@DIRECTIONS
@pytest.mark.slow
async def test_short_partition_loses_nothing(tmp_path, directions):
    with RealCluster(tmp_path) as cluster:
        counted, stats, lost_s = await cut_while_it_runs(
            cluster, directions, count=60, task="slow", cut_s=5.0, other=""
        )
    figures = {"redispatched": stats.redispatched, "stale": stats.stale_results}
    print_figures(f"A6 5 s, {' and '.join(directions)}", counted, **figures)
    assert counted.clean
    assert lost_s is None
    # A lease in transit may be re-dispatched and a result sent twice, but no rollout runs twice.
    assert set(cluster.executed().values()) == {1}


async def cut_for_long(folder, directions, *, cut_s, **settings):
    with RealCluster(folder, **settings) as cluster:
        counted, stats, lost_s = await cut_while_it_runs(
            cluster, directions, count=2, task="first slow", cut_s=cut_s, other="w2"
        )
        print_figures(
            f"A6 {cut_s:g} s, {' and '.join(directions)}",
            counted,
            redispatched=stats.redispatched,
            stale=stats.stale_results,
            detection_s=lost_s,
        )
        assert counted.clean
        if TO_MANAGER in directions:
            assert stats.redispatched == 2
            assert set(cluster.executed().values()) == {2}
        else:
            # The results arrive, but their acknowledgements are lost, so the worker sends them again.
            assert stats.redispatched == 0
            assert set(cluster.executed().values()) == {1}
        return stats


async def test_rollout_on_partitioned_worker_is_redispatched_once(tmp_path):
    both = (TO_MANAGER, TO_WORKER)
    stats = await cut_for_long(tmp_path, both, cut_s=4.0, heartbeat_s=0.2, lost_after_s=1.0)
    assert stats.stale_results == 2


@DIRECTIONS
@pytest.mark.slow
async def test_rollout_on_worker_partitioned_for_a_minute_is_redispatched_once(tmp_path, directions):
    stats = await cut_for_long(tmp_path, directions, cut_s=60.0)
    # A worker that hears of its lost session stops; otherwise its results arrive late and are rejected.
    assert stats.stale_results in (0, 2)


@pytest.mark.slow
async def test_worker_stops_leases_that_it_cannot_renew(tmp_path):
    settings = {"heartbeat_s": 0.2, "lost_after_s": 1.5, "lease_ttl_s": 4.0}
    with RealCluster(tmp_path, **settings) as cluster:
        counted, stats, _ = await cut_while_it_runs(
            cluster, (TO_MANAGER, TO_WORKER), count=2, task="first hangs", cut_s=12.0, other="w2"
        )
        print_figures("A6 leases that run out", counted, redispatched=stats.redispatched)
        assert counted.clean
        assert stats.stale_results == 0
        assert re.search(r"leases given up count=2: no heartbeat was answered", cluster.log("w1"))
