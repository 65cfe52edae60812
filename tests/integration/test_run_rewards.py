"""Reward coefficients of a run reach its workers, and bad ones are refused."""

import asyncio

import pytest
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BUNDLES, batch, manager, outcomes, until

from embomatrix.proto.v1 import rollout_service_pb2, rollout_service_pb2_grpc, types_pb2
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import ConflictError, InvalidRequestError, cluster_errors
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.values import Completed, GroupPolicy, RunTerms

pytestmark = pytest.mark.timeout(60)
OWN = RewardSettings(unparsable=-2.0, format=1.0, relevance_per_object=0.0, relevance_limit=0.0, goal=8.0)
TERMS = RunTerms(GroupPolicy.PARTIAL, reward=OWN)


def totals(results):
    assert all(isinstance(result.outcome, Completed) for result in results.values())
    return {result.outcome.reward.total for result in results.values()}


async def open_run(client, terms, run_id="r1"):
    await client.open_run("test", run_id, terms)
    await client.put_bundles(BUNDLES)


async def test_each_run_is_scored_with_its_own_coefficients(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client, FakeWorker(at.address, slots=2):
        await open_run(client, TERMS)
        await open_run(client, RunTerms(), "r2")
        own, usual = batch(4), batch(4, batch_id="b2", run_id="r2")
        scored = await asyncio.gather(outcomes(client, own), outcomes(client, usual))
        assert [totals(results) for results in scored] == [{5.0}, {0.5 + 15.0}]
        infos = {info.run_id: info.reward for info in await _runs(at.address)}
        assert infos == {"r1": OWN, "r2": PAPER}
        await client.close_run("r1")
        async with AdminClient(at.address) as admin:
            assert (await admin.run("r1")).run.reward == OWN


async def _runs(address):
    async with AdminClient(address) as admin:
        return await admin.list_runs()


async def test_redispatched_rollout_keeps_its_reward_coefficients(
    tmp_path,
):
    state = {"state": f"sqlite:{tmp_path / 'state.sqlite'}", "restart_grace_s": 0.3}
    async with manager(tmp_path, **state) as at, ClusterClient(at.address) as client:
        await open_run(client, TERMS)
        async with FakeWorker(at.address, stuck={"t"}) as killed:
            running = asyncio.create_task(outcomes(client, batch(2)))
            await until(lambda: killed.executed)
        async with FakeWorker(at.address, worker_id="w2", stuck={"t"}) as second:
            await until(lambda: second.executed)
            assert {lease.reward for lease in second.leases.values()} == {OWN}
        running.cancel()
    async with (
        manager(tmp_path, **state) as at,
        ClusterClient(at.address) as client,
        FakeWorker(at.address, worker_id="w3"),
    ):
        assert totals(await outcomes(client, batch(2))) == {5.0}


async def test_invalid_coefficients_are_refused_at_open_run(tmp_path):
    async with manager(tmp_path) as at, open_channel(at.address) as channel:
        stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
        bad = types_pb2.RewardSettings(unparsable=-1, format=0.5, goal=-30)
        with (
            pytest.raises(InvalidRequestError, match=r"reward\.goal: found -30: expected 0 or more"),
            cluster_errors(at.address),
        ):
            await stub.OpenRun(
                rollout_service_pb2.OpenRunRequest(
                    run_id="r1", protocol_version=PROTOCOL_VERSION, reward=bad
                ),
                timeout=5,
            )
        assert await _runs(at.address) == ()


async def test_open_run_refuses_other_reward_coefficients(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        await open_run(client, TERMS)
        assert await client.open_run("again", "r1", TERMS) == "r1"
        assert await client.open_run("whatever it has", "r1") == "r1"
        with pytest.raises(ConflictError, match=r"'r1' was opened with other reward coefficients"):
            await client.open_run("others", "r1", RunTerms(reward=RewardSettings(goal=1.0)))
