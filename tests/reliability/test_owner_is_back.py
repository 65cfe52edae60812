"""A spare PC whose owner returns during a batch, with real processes and a real terminal."""

import asyncio

import pytest
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

from embomatrix.worker.link.status import running_daemons

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


async def _standing(client, name):
    [worker] = [worker for worker in await client.list_workers() if worker.worker_id == name]
    return worker.state, worker.reason


async def _until_standing(client, name, expected, limit_s=60.0):
    async with asyncio.timeout(limit_s):
        while await _standing(client, name) != expected:  # noqa: ASYNC110
            await asyncio.sleep(0.05)


async def test_worker_pauses_for_its_owner_and_resumes_without_loss(tmp_path):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_worker("spare", idle_s=3.0, grace_s=0.2, calm_s=0.2, check_s=0.1)
        async with cluster.client() as client:
            await connected(client, "spare")
            batch = batch_of(await opened(client), 24, "slow")
            running = asyncio.create_task(outcomes(client, batch))
            await until(lambda: len(cluster.executed()) >= 4)
            cluster.type_at("spare")
            await _until_standing(client, "spare", ("paused", "its owner is active"))
            assert not running.done()
            await until(lambda: [status.paused for status in running_daemons(tmp_path / "spare")] != [""])
            [status] = running_daemons(tmp_path / "spare")
            await _until_standing(client, "spare", ("ready", ""))
            results = await running
            stats = await client.close_run(batch.run_id)
        counted = tally(batch, results)
        print_figures("owner", counted, redispatched=stats.redispatched, paused_for=status.paused)
        assert counted.clean
        assert status.paused == "its owner is active"
        assert {result.attempt for result in results} == {1}
