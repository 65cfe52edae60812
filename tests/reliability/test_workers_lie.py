"""A17: audits find a worker that fabricates results before they are delivered."""

import asyncio

from tests.fakes.real_cluster import RealCluster, batch_of, connected, opened, outcomes, print_figures, tally
from tests.fakes.simulation import graded_total

from embomatrix.manager.runtime.intake import TICK_S
from embomatrix.rpc.wire.values import GroupPolicy, RunTerms

HONEST = ("w1", "w2", "w3")
LIAR = "liar"


async def test_lying_worker_is_quarantined_before_any_false_result_is_delivered(tmp_path):
    batch = batch_of("run", 400, "graded")
    # The probability to escape all audits is 0.9^100, 3 in 100,000.
    with RealCluster(tmp_path, audit_probation=100) as cluster:
        cluster.start_manager()
        for name in HONEST:
            cluster.start_worker(name)
        cluster.start_worker(LIAR, lies=0.1)
        async with cluster.client() as client:
            await connected(client, *HONEST, LIAR)
            await opened(client, "run", terms=RunTerms(GroupPolicy.PARTIAL, verified=True))
            results = await asyncio.wait_for(outcomes(client, batch), 120)
            workers = {worker.worker_id: worker for worker in await client.list_workers()}
            stats = await client.close_run("run")
        counted = tally(batch, results, reward=graded_total)
        liar = workers[LIAR]
        print_figures(
            "A17",
            counted,
            audited=stats.audited,
            mismatches=stats.audit_mismatches,
            compared_of_the_liar=liar.audited,
            executed_again=stats.redispatched,
        )
        assert counted.clean
        assert liar.state == "quarantined"
        assert "contradicts" in liar.reason
        assert liar.audit_mismatches >= 1
        assert all(workers[name].state == "ready" for name in HONEST)
        assert f"worker quarantined worker={LIAR}" in cluster.log("manager")


async def test_single_worker_is_not_audited_with_one_warning(tmp_path):
    batch = batch_of("run", 20)
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_worker("w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            await opened(client, "run", terms=RunTerms(verified=True))
            results = await asyncio.wait_for(outcomes(client, batch), 60)
            stats = await client.close_run("run")
        assert tally(batch, results).clean
        assert stats.audited == 0
        said = "results are not audited: auditing needs a second worker"
        async with asyncio.timeout(20):
            while said not in cluster.log("manager"):  # noqa: ASYNC110  # a file has no notifications
                await asyncio.sleep(0.05)
        await asyncio.sleep(4 * TICK_S)
        assert cluster.log("manager").count(said) == 1
