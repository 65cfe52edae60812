"""Acceptance test A10: sides of this version and of the one before, in every pairing, and sides that are further apart."""

import asyncio

import numpy as np
import pytest
from tests.fakes.cluster import FakeCluster
from tests.fakes.guarded import packed
from tests.fakes.simulation import PROGRAM
from tests.fakes.version_one import NarrowChannel, VersionOneManager, serving_version_one
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import manager, until

from embomatrix.proto.v1 import (
    rollout_service_pb2,
    rollout_service_pb2_grpc,
    scene_service_pb2,
    scene_service_pb2_grpc,
)
from embomatrix.rpc.capabilities import capabilities_of
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import PreconditionError, cluster_errors
from embomatrix.rpc.versions import SPOKEN, VersionRange, agree
from embomatrix.rpc.wire.batch import batch_to_proto
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.values import Batch, Completed, Resources, Rollout
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon

pytestmark = pytest.mark.timeout(60)

KITCHEN, DATA = packed("ok")


def batch(count, batch_id="b1"):
    rollouts = tuple(Rollout(f"{batch_id}-{i}", f"g{i // 4}", KITCHEN, "ok", (), i) for i in range(count))
    return Batch("r1", batch_id, 1, rollouts)


def old_worker(at, name="old", **options):
    return FakeWorker(at.address, worker_id=name, through=NarrowChannel, protocol=1, **options)


class OldTrainer:
    """A trainer of version 1: it says nothing of versions, asks nothing about them, and reads results alone."""

    def __init__(self, address):
        self._address = address

    async def __aenter__(self):
        self._channel = NarrowChannel(open_channel(self._address))
        self._rollouts = rollout_service_pb2_grpc.RolloutServiceStub(self._channel)
        scenes = scene_service_pb2_grpc.SceneServiceStub(self._channel)
        # Of the newer version, to see that it does not reach the manager.
        newer = rollout_service_pb2.OpenRunRequest(run_id="r1", protocol_version=99, weight=-1.0)
        await self._rollouts.OpenRun(newer, timeout=5)
        put = scene_service_pb2.PutBundleRequest(bundle_digest=KITCHEN, chunk=DATA)

        async def chunks():
            yield put

        await scenes.PutBundle(chunks(), timeout=5)
        return self

    async def __aexit__(self, *_):
        await self._channel.close()

    async def outcomes(self, submitted):
        stream = self._rollouts.Execute(batch_to_proto(submitted), timeout=30)
        return [rollout_result_from_proto(found) async for answer in stream for found in answer.results]


async def test_workers_and_trainers_of_the_version_before_work_with_this_manager(tmp_path):
    async with manager(tmp_path) as at, OldTrainer(at.address) as trainer, old_worker(at, slots=2) as worker:
        results = await trainer.outcomes(batch(100))
    assert len({result.rollout_id for result in results}) == len(results) == 100
    assert all(isinstance(result.outcome, Completed) for result in results)
    assert len(worker.executed) == 100


async def test_an_upgrade_machine_by_machine_drops_no_rollout(tmp_path, capsys):
    """Old and new workers side by side; in the middle of a batch the old one is replaced by a new one of its name."""
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        await client.open_run("upgrade", "r1")
        await client.put_bundles({KITCHEN: DATA})
        old = await old_worker(at, "w1", slots=2, execute_s=0.02).__aenter__()
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


async def test_this_worker_works_with_a_manager_of_the_version_before_and_leaves_it_cleanly(tmp_path):
    before = VersionOneManager()
    digest = before.bundle(b"ok")
    async with serving_version_one(before, "WorkerService") as (address, called):
        settings = WorkerSettings(manager=address, name="w1", cache_dir=tmp_path, state_dir=tmp_path)
        daemon = Daemon(settings, Resources(2, 2, 500), np.random.default_rng(0), program=PROGRAM)
        working = asyncio.create_task(daemon.run())
        await until(lambda: before.states, within_s=20)
        before.want(digest)
        for number in range(20):
            before.lease(f"l{number}", digest)
        await until(lambda: len(before.results) == 20 and "Heartbeat" in called, within_s=20)
        daemon.stop()
        await working
    assert called.count("Register") == 2, "it asks by its own version first, then by the one before"
    assert [request.protocol_version for request in before.registrations] == [1]
    assert all(isinstance(result.outcome, Completed) for result in before.results)
    assert "Deregister" not in called


async def test_this_trainer_works_with_a_manager_of_the_version_before():
    before = FakeCluster()
    async with (
        serving_version_one(before, "RolloutService", "SceneService") as (address, _),
        ClusterClient(address) as client,
    ):
        assert await client.open_run("test", "r1") == "r1"
        await client.put_bundles({KITCHEN: DATA})
        assert len(await collected(client, batch(10))) == 10


async def test_a_manager_tells_what_it_speaks_before_it_asks_for_anything(tmp_path):
    async with manager(tmp_path, token="secret") as at, open_channel(at.address) as channel:
        found = await capabilities_of(
            rollout_service_pb2_grpc.RolloutServiceStub(channel), at.address, timeout_s=5
        )
    assert found.protocol == SPOKEN
    assert (found.batch_rollouts, found.bundle_bytes) == (65_536, 8 * 1024 * 1024)


async def test_a_trainer_of_a_version_that_nobody_knows_yet_is_refused(tmp_path):
    async with manager(tmp_path) as at, open_channel(at.address) as channel:
        stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
        with (
            pytest.raises(PreconditionError, match=r"upgrade this manager with `pip install --upgrade"),
            cluster_errors(at.address),
        ):
            await stub.OpenRun(rollout_service_pb2.OpenRunRequest(protocol_version=3), timeout=5)


@pytest.mark.parametrize(
    ("ours", "theirs", "agreed"),
    [((1, 2), (1, 2), 2), ((1, 2), (2, 3), 2), ((1, 2), (1, 1), 1), ((2, 3), (1, 2), 2), ((2, 2), (2, 2), 2)],
)
def test_two_sides_speak_the_newest_version_of_both(ours, theirs, agreed):
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
def test_who_is_behind_is_told_the_command_that_upgrades_it(ours, theirs, sentence):
    with pytest.raises(PreconditionError, match=sentence):
        agree(
            VersionRange(*ours),
            VersionRange(*theirs),
            us="this manager",
            them="worker w1",
            their_release="7.0",
        )
