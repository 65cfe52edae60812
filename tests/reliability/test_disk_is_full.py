"""The manager's disk fills up during a batch: no result is lost, and the batch continues once there is space."""

import asyncio
import resource

import httpx
import psutil
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

from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.status import OverloadedError

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


async def test_full_disk_delays_results_and_refuses_new_runs(tmp_path):
    with RealCluster(tmp_path) as cluster:
        page_port = free_port()
        cluster.start_manager(http_port=page_port)
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 400, "brief")
            seen = []
            running = asyncio.create_task(outcomes(client, batch, then=seen.append))
            await until(lambda: len(seen) >= 20)
            manager = psutil.Process(cluster.processes["manager"].pid)
            # No file of this process may grow, as on a disk without room.
            manager.rlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            await until(lambda: "make room on its disk" in cluster.log("manager"))
            with pytest.raises(OverloadedError, match="make room on its disk"):
                await client.open_run("another")
            waited_at = len(seen)
            asked = f"http://127.0.0.1:{page_port}/api/v1/snapshot"
            response = await asyncio.to_thread(httpx.get, asked)
            assert "make room on its disk" in response.json()["health"]["sentence"]
            await asyncio.sleep(2.0)
            assert len(seen) == waited_at, "a result was shown that is not written down"
            manager.rlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            results = await running
        counted = tally(batch, results)
        print_figures("disk full", counted, delivered_before=waited_at)
        assert counted.clean
        assert set(cluster.executed().values()) == {1}
