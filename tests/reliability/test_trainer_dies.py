"""A7 and A16: a restarted trainer reads missed results, and faults change no advantage of a complete group."""

import pytest
import torch
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
from tests.fakes.simulation import graded_total

from embomatrix.rpc.wire.values import Completed
from embomatrix.trainer.learning.objective import group_advantages

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


async def test_restarted_trainer_reads_all_results_without_repeats(
    tmp_path,
):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = batch_of(await opened(client), 100, "brief")
            out = tmp_path / "seen.txt"
            cluster.start_trainer("trainer", batch, "brief", out)
            await until(lambda: out.exists() and len(out.read_text().split()) >= 30)
            cluster.signal("trainer")
            read_before = len(out.read_text().split())
            results = await outcomes(client, batch)
            again = await outcomes(client, batch)
        counted = tally(batch, results)
        print_figures("A7", counted, read_before=read_before, executed=sum(cluster.executed().values()))
        assert counted.clean
        assert {(one.rollout_id, one.cursor) for one in again} == {
            (one.rollout_id, one.cursor) for one in results
        }
        assert set(cluster.executed().values()) == {1}


async def test_faults_do_not_change_advantages_of_complete_groups(tmp_path):
    async with two_workers(tmp_path, restart_grace_s=8.0) as (cluster, client):
        await opened(client, "quiet")
        await opened(client, "faulty")
        quiet = await outcomes(client, batch_of("quiet", 800, "graded"))

        def fault(seen):
            if seen == 100:
                cluster.signal("w1")
                cluster.start_worker("w1")
            if seen == 300:
                cluster.signal("manager")
                cluster.start_manager()

        faulty = await outcomes(client, batch_of("faulty", 800, "graded"), then=fault)
        await connected(client, "w1", "w2")
        counted = tally(batch_of("faulty", 800, "graded"), faulty, graded_total)
        expected, found = advantages(quiet), advantages(faulty)
        print_figures("A16", counted, groups=len(found))
        assert counted.delivered == 800
        assert counted.fabricated == 0
        assert len(expected) == 100
        assert len(found) >= 95
        for group, row in found.items():
            assert torch.equal(row, expected[group])


def advantages(results):
    """Return advantages by group in rollout order, without groups that had an infrastructure failure."""
    rewards = {}
    for result in sorted(results, key=lambda one: int(one.rollout_id.rpartition("-")[2])):
        complete = isinstance(result.outcome, Completed)
        rewards.setdefault(result.group_id, []).append(result.outcome.reward.total if complete else None)
    whole = {group: row for group, row in rewards.items() if None not in row}
    return {group: group_advantages(torch.tensor([row])).values for group, row in whole.items()}
