"""Acceptance test A10: version negotiation, and a worker that is replaced during a batch."""

import asyncio

import pytest
from tests.fakes.guarded import packed
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import manager, until

from embomatrix.proto.v1 import (
    rollout_service_pb2,
    rollout_service_pb2_grpc,
)
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import PreconditionError, cluster_errors
from embomatrix.rpc.versions import SPOKEN, VersionRange, agree, capabilities_of
from embomatrix.rpc.wire.values import Batch, Completed, Rollout

pytestmark = pytest.mark.timeout(60)

KITCHEN, DATA = packed("ok")


def batch(count, batch_id="b1"):
    rollouts = tuple(Rollout(f"{batch_id}-{i}", f"g{i // 4}", KITCHEN, "ok", (), i) for i in range(count))
    return Batch("r1", batch_id, 1, rollouts)


async def test_replacing_a_worker_during_a_batch_loses_no_rollout(tmp_path, capsys):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        await client.open_run("upgrade", "r1")
        await client.put_bundles({KITCHEN: DATA})
        old = await FakeWorker(at.address, worker_id="w1", slots=2, execute_s=0.02).__aenter__()
        running = asyncio.create_task(collected(client, batch(200)))
        await until(lambda: len(old.executed) > 20)
        async with FakeWorker(at.address, worker_id="w2", slots=2, execute_s=0.01):
            await old.kill()
            async with FakeWorker(at.address, worker_id="w1", slots=2, execute_s=0.01) as upgraded:
                results = await running
                assert upgraded.executed
        stats = await client.close_run("r1")
    with capsys.disabled():
        print(
            f"\nA10: delivered {stats.delivered} of 200, duplicates 0, redispatched {stats.redispatched}, lost 0"
        )
    assert len({result.rollout_id for result in results}) == len(results) == 200
    assert all(isinstance(result.outcome, Completed) for result in results)
    assert (stats.delivered, stats.infra_failures) == (200, 0)


async def collected(client, submitted):
    return [result async for result in client.execute(submitted, deadline_s=40)]


async def test_capabilities_need_no_token(tmp_path):
    async with manager(tmp_path, token="secret") as at, open_channel(at.address) as channel:
        found = await capabilities_of(rollout_service_pb2_grpc.RolloutServiceStub(channel), timeout_s=5)
    assert found.protocol == SPOKEN
    assert (found.batch_rollouts, found.bundle_bytes) == (65_536, 8 * 1024 * 1024)


async def test_trainer_of_an_unknown_version_is_refused(tmp_path):
    async with manager(tmp_path) as at, open_channel(at.address) as channel:
        stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
        with (
            pytest.raises(PreconditionError, match=r"upgrade this manager with `pip install --upgrade"),
            cluster_errors(at.address),
        ):
            await stub.OpenRun(rollout_service_pb2.OpenRunRequest(protocol_version=4), timeout=5)


@pytest.mark.parametrize(
    ("ours", "theirs", "agreed"),
    [((1, 2), (1, 2), 2), ((1, 2), (2, 3), 2), ((1, 2), (1, 1), 1), ((2, 3), (1, 2), 2), ((2, 2), (2, 2), 2)],
)
def test_newest_common_version_is_negotiated(ours, theirs, agreed):
    sides = {"us": "this manager", "them": "worker w1"}
    assert agree(VersionRange(*ours), VersionRange(*theirs), **sides) == agreed
    assert agree(VersionRange(*theirs), VersionRange(*ours), **sides) == agreed


@pytest.mark.parametrize(
    ("ours", "theirs", "sentence"),
    [
        (
            (2, 3),
            (1, 1),
            r"worker w1 speaks protocol 1, this manager 2 to 3: upgrade worker w1 with `pip .*\[worker\]",
        ),
        ((1, 2), (3, 4), r"upgrade this manager with `pip install --upgrade 'embomatrix\[manager\]==7\.0'`"),
    ],
)
def test_version_error_names_the_upgrade_command(ours, theirs, sentence):
    with pytest.raises(PreconditionError, match=sentence):
        agree(
            VersionRange(*ours),
            VersionRange(*theirs),
            us="this manager",
            them="worker w1",
            their_release="7.0",
        )
