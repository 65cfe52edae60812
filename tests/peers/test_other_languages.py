"""JavaScript worker of docs/examples, written from docs/protocol.md, in a cluster of real processes."""

import asyncio
import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from tests.fakes.peers import EXAMPLES, ROOT
from tests.fakes.real_cluster import RealCluster, connected, outcomes, print_figures, tally, until
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.rpc.wire.values import Batch, Completed, InfraCode, Rollout
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.inflation import bundle_digest

PACKAGES = ("@grpc/grpc-js@1.14.7", "@grpc/proto-loader@0.8.1")
ROOM = SkillCall(Skill.GO_TO_ROOM, room_name="kitchen_0")
NOWHERE = SkillCall(Skill.GO_TO_ROOM, room_name="attic_0")
PICK_UP = SkillCall(Skill.PICK_UP, object_index=1)

pytestmark = [
    pytest.mark.peers,
    pytest.mark.timeout(300),
    pytest.mark.skipif(shutil.which("npm") is None, reason="there is no npm: install Node.js"),
]


@pytest.fixture(scope="module")
def program():
    """Copy the worker beside its packages."""
    base = os.environ.get("EMBOMATRIX_PEERS") or Path.home() / ".cache" / "embomatrix" / "peers"
    folder = Path(base) / "node"
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "node_modules").is_dir():
        npm = ["npm", "install", "--ignore-scripts", "--no-audit", "--no-fund", "--prefix", folder, *PACKAGES]
        subprocess.run(npm, check=True, capture_output=True)
    return shutil.copy(EXAMPLES / "worker.mjs", folder)


@pytest.fixture(scope="module")
def bundle():
    """Return the bundle's bytes and the id of one of its tasks."""
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    return encode_bundle(Bundle(scene, tasks)), next(iter(tasks))


async def opened(client, data, task_id, plans, run_id="run"):
    """Open a run with a batch of these plans."""
    digest = bundle_digest(data)
    await client.put_bundles({digest: data})
    await client.open_run("another language", run_id)
    rollouts = (Rollout(f"r{n}", f"g{n}", digest, task_id, tuple(plan), n) for n, plan in enumerate(plans))
    return Batch(run_id, "b1", 0, tuple(rollouts))


async def test_javascript_worker_survives_a_manager_restart_and_leaves_on_sigterm(tmp_path, program, bundle):
    plans = [[ROOM] * 20] * 150
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_program("w1", "node", program, ROOT / "proto")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = await opened(client, *bundle, plans)
            running = asyncio.create_task(
                outcomes(client, batch, then=lambda seen: seen == 40 and cluster.signal("manager"))
            )
            await until(lambda: "manager" not in cluster.processes or running.done())
            cluster.start_manager()
            results = await running
            (run,) = await client.list_runs()
            cluster.signal("w1", signal.SIGTERM)
            assert await asyncio.to_thread(cluster.processes["w1"].wait, 20) == 0, cluster.log("w1")
            (gone,) = await client.list_workers()
            assert (gone.state, gone.reason) == ("left", "it left")
        counted = tally(batch, results, reward=0.5)
        print_figures("a worker in JavaScript", counted, redispatched=run.stats.redispatched)
        assert counted.clean
        assert run.stats.redispatched == 0
        assert [len(result.outcome.steps) for result in results] == [20] * len(plans)


async def test_unsupported_skill_fails_the_rollout_and_unknown_room_fails_the_step(tmp_path, program, bundle):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_program("w1", "node", program, ROOT / "proto")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = await opened(client, *bundle, [[ROOM, NOWHERE, ROOM], [PICK_UP]])
            results = {result.rollout_id: result.outcome for result in await outcomes(client, batch)}
    walked, lost = results["r0"], results["r1"]
    assert isinstance(walked, Completed)
    assert [step.failure for step in walked.steps] == [None, FailureReason.UNKNOWN_ROOM]
    assert "the rooms are" in walked.steps[1].message
    assert lost.code is InfraCode.SLOT_CRASHED
    assert "this worker does not support SKILL_KIND_PICK_UP" in lost.message
