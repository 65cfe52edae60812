"""Equal rollouts that run once: each gets exactly one outcome, whichever process dies."""

import asyncio
from dataclasses import replace

import pytest
from tests.fakes.real_cluster import batch_of, connected, opened, outcomes, tally, two_workers, until

pytestmark = pytest.mark.timeout(240)
EQUAL = 8


def groups_of_equal_rollouts(run_id, count):
    batch = batch_of(run_id, count, "brief", group=EQUAL)
    rollouts = tuple(replace(one, seed=number // EQUAL) for number, one in enumerate(batch.rollouts))
    return replace(batch, rollouts=rollouts)


@pytest.mark.parametrize("victim", ["w1", "manager"])
async def test_every_equal_rollout_has_one_outcome_after_a_death(tmp_path, victim):
    async with two_workers(tmp_path, restart_grace_s=2.0) as (cluster, client):
        batch = groups_of_equal_rollouts(await opened(client), 400)

        def kill(seen):
            if seen == 80:
                cluster.signal(victim)

        running = asyncio.create_task(outcomes(client, batch, then=kill))
        await until(lambda: victim not in cluster.processes or running.done())
        if victim == "manager":
            cluster.start_manager()
            await connected(client, "w1", "w2")
        results = await running
        stats = await client.close_run(batch.run_id)
        executed = cluster.executed()
    assert tally(batch, results).clean
    # Only the first rollout of each group is ever executed.
    assert len(executed) == 400 // EQUAL
    assert set(executed) <= {rollout.rollout_id for rollout in batch.rollouts[::EQUAL]}
    assert stats.infra_failures == 0
    for group in range(400 // EQUAL):
        found = [result for result in results if result.group_id == f"g{group}"]
        assert len({(result.cursor, result.attempt, result.outcome.trace_digest) for result in found}) == 1
