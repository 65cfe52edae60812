"""A3: rollouts that crash, hang or exhaust memory fail alone while the cluster's other rollouts continue.

Slots with real physics are tested in tests/integration/test_slots_with_physics.py.
"""

import asyncio
import time

import pytest
from tests.fakes.real_cluster import DIGEST, RealCluster, connected, opened, outcomes, print_figures, tally

from embomatrix.rpc.wire.values import Batch, Completed, InfraCode, Rollout

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]

BAD = {"crash": InfraCode.SLOT_CRASHED, "hang": InfraCode.SLOT_TIMEOUT, "greedy": InfraCode.SLOT_OOM}


async def test_failing_slot_fails_only_its_own_rollout(tmp_path):
    good = [Rollout(f"good-{number}", f"good-{number}", DIGEST, "brief", (), 0) for number in range(200)]
    bad = [Rollout(task, task, DIGEST, task, (), 0) for task in BAD]
    batch = Batch("run", "b1", 0, (*bad, *good))
    with RealCluster(tmp_path, execute_deadline_s=2.0, max_attempts=2) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1", slots=3)
        async with cluster.client() as client:
            await connected(client, "w1")
            await opened(client, "run")
            began_s = time.monotonic()
            results = await asyncio.wait_for(outcomes(client, batch), 120)
            took_s = time.monotonic() - began_s
            workers = await client.list_workers()
        counted = tally(batch, results)
        print_figures("A3", counted, seconds=took_s)
        found = {result.rollout_id: result.outcome for result in results}
        assert all(isinstance(found[rollout.rollout_id], Completed) for rollout in good)
        assert {task: found[task].code for task in BAD} == BAD
        assert (counted.delivered, counted.duplicates, counted.fabricated) == (203, 0, 0)
        assert [worker.state for worker in workers] == ["ready"]
