"""Recorded plans of a training run have the results of plain executions, however they are shared, merged and interrupted."""

import contextlib
import dataclasses
import itertools

import pytest
from tests.fakes.real_cluster import LIMITS, RealCluster, connected

from embomatrix.bench.traffic.recording import sampled_traffic
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE, PhysicsScene
from embomatrix.world.bundle import decode_bundle

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def recorded():
    """Return the bundles and the groups of two of the sample's scenes, of both phases."""
    traffic = sampled_traffic()
    scenes = list(traffic.bundles)[:1] + list(traffic.bundles)[-1:]
    groups = [
        group.rollouts(phase)
        for phase, part in (("early/", traffic.early), ("late/", traffic.late))
        for group in part
        if group.bundle_digest in scenes
    ]
    return {digest: traffic.bundles[digest] for digest in scenes}, groups


@pytest.fixture(scope="module")
def plain(recorded):
    """Return the result of each rollout that is executed from its start."""
    bundles, groups = recorded
    results = {}
    with contextlib.closing(ClientPool(spare=CLIENTS_PER_SCENE)) as clients:
        for digest, data in bundles.items():
            scene = PhysicsScene(decode_bundle(data, digest=digest), clients, sharing=False)
            for rollout in itertools.chain(*groups):
                if rollout.bundle_digest == digest:
                    results[rollout.rollout_id] = scene.execute(rollout)
            scene.close()
    return results


def content(completed):
    assert isinstance(completed, Completed)
    return completed.reward, completed.steps, completed.final, completed.trace_digest


@pytest.mark.parametrize(
    ("workers", "slots", "killed"), [(1, 1, False), (1, 3, False), (2, 2, True)], ids=str
)
async def test_results_are_those_of_plain_execution(tmp_path, recorded, plain, workers, slots, killed):
    bundles, groups = recorded
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        for number in range(workers):
            cluster.start_real_worker(f"w{number}", slots)
        async with ClusterClient(cluster.address, limits=LIMITS) as client:
            await connected(client, *(f"w{number}" for number in range(workers)))
            await client.open_run("sharing", "r1")
            await client.put_bundles(bundles)
            batch = Batch("r1", "b1", 1, tuple(itertools.chain(*groups)))
            results = {}
            async for result in client.execute(batch, deadline_s=200):
                results[result.rollout_id] = result.outcome
                if killed and len(results) > len(plain) // 3:
                    cluster.signal("w1")
                    killed = False
            stats = await client.close_run("r1")
    assert {name: content(one) for name, one in results.items()} == {
        name: content(one) for name, one in plain.items()
    }
    assert stats.delivered == len(plain)
    assert stats.steps == sum(len(one.steps) for one in plain.values())
    assert stats.shared_steps == sum(one.shared_steps for one in results.values())
    assert stats.shared_share > 0.6


async def test_client_that_does_not_merge_gets_the_same_results(tmp_path, recorded, plain):
    bundles, groups = recorded
    some = [
        dataclasses.replace(one, rollout_id=f"x/{one.rollout_id}") for one in itertools.chain(*groups[:4])
    ]
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_real_worker("w0", 2)
        async with ClusterClient(cluster.address, limits=LIMITS, merging=False) as client:
            await connected(client, "w0")
            await client.open_run("plain", "r1")
            await client.put_bundles(bundles)
            found = [
                result async for result in client.execute(Batch("r1", "b1", 1, tuple(some)), deadline_s=100)
            ]
            assert len({result.cursor for result in found}) == len(some)
    assert {one.rollout_id: content(one.outcome) for one in found} == {
        one.rollout_id: content(plain[one.rollout_id.removeprefix("x/")]) for one in some
    }
