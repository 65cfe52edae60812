"""JavaScript worker of docs/examples, written from the documents alone, in a cluster of real processes."""

import asyncio
import os
import shutil
import signal
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from tests.fakes.peers import EXAMPLES, ROOT
from tests.fakes.real_cluster import RealCluster, connected, outcomes, print_figures, tally, until
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Batch, Completed, GroupPolicy, InfraCode, Rollout, RunTerms
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.inflation import bundle_digest

PACKAGES = ("@grpc/grpc-js@1.14.7", "@grpc/proto-loader@0.8.1")
ROOM = SkillCall(Skill.GO_TO_ROOM, room_name="kitchen_0")
OTHER_ROOM = SkillCall(Skill.GO_TO_ROOM, room_name="living_room_0")
NOWHERE = SkillCall(Skill.GO_TO_ROOM, room_name="attic_0")
PICK_UP = SkillCall(Skill.PICK_UP, object_index=1)
LARGEST, SMALLEST = 2**63 - 1, -(2**63)
TASK = "light_and_air"
"""None of its atoms holds at the start; of ``tidy_up`` one of three does."""
PARTIAL = RunTerms(GroupPolicy.PARTIAL)

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
    """Return a bundle's bytes."""
    scene = kitchen_scene()
    return encode_bundle(Bundle(scene, {task.task_id: task for task in kitchen_tasks(scene)}))


def start(cluster, program, *names, **environment):
    for name in names:
        cluster.start_program(name, "node", program, ROOT / "proto", **environment)


async def opened(client, data, plans, task_id=TASK, run_id="run", terms=PARTIAL):
    """Open a run; return a batch of these plans with seeds that need all 64 bits."""
    digest = bundle_digest(data)
    await client.put_bundles({digest: data})
    await client.open_run("another language", run_id, terms)
    rollouts = (
        Rollout(f"r{n}", f"g{n}", digest, task_id, tuple(plan), 2**64 - 1 - n) for n, plan in enumerate(plans)
    )
    return Batch(run_id, "b1", 0, tuple(rollouts))


async def executed_despite_a_killed_manager(cluster, client, batch, after):
    """Execute the batch; kill the manager after this many results, and start another."""
    running = asyncio.create_task(
        outcomes(client, batch, then=lambda seen: seen == after and cluster.signal("manager"))
    )
    await until(lambda: "manager" not in cluster.processes or running.done())
    cluster.start_manager()
    return await running


async def trusted(client, *names):
    """Return the number of compared executions of these workers. None may be in quarantine, or have differed."""
    workers = {worker.worker_id: worker for worker in await client.list_workers()}
    assert {workers[name].state for name in names} == {"ready"}, workers
    assert sum(workers[name].audit_mismatches for name in names) == 0
    return [workers[name].audited for name in names]


async def test_javascript_worker_survives_a_manager_restart_and_leaves_on_sigterm(tmp_path, program, bundle):
    plans = [[ROOM] * 20] * 150
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        start(cluster, program, "w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = await opened(client, bundle, plans)
            results = await executed_despite_a_killed_manager(cluster, client, batch, after=40)
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


async def test_two_javascript_workers_confirm_each_other_across_a_killed_manager(tmp_path, program, bundle):
    """The manager audits every result. Every third plan fails at its first call."""
    plans = [[ROOM, OTHER_ROOM] * 5, [NOWHERE, ROOM], [ROOM, NOWHERE]] * 40
    with RealCluster(tmp_path, audit=True) as cluster:
        cluster.start_manager()
        start(cluster, program, "w1", "w2")
        async with cluster.client() as client:
            await connected(client, "w1", "w2")
            batch = await opened(client, bundle, plans)
            results = await executed_despite_a_killed_manager(cluster, client, batch, after=30)
            audited = await trusted(client, "w1", "w2")
    counted = tally(batch, results, reward=0.5)
    print_figures("two workers in JavaScript", counted, audited=min(audited))
    assert counted.clean
    assert min(audited) >= 30
    steps = {result.rollout_id: [step.failure for step in result.outcome.steps] for result in results}
    assert steps["r0"] == [None] * 10
    assert steps["r1"] == [FailureReason.UNKNOWN_ROOM]
    assert steps["r2"] == [None, FailureReason.UNKNOWN_ROOM]


async def test_javascript_and_python_workers_agree(tmp_path, program, bundle):
    """The same plans on both: atoms, success, outcomes of steps and rewards are compared for every rollout."""
    plans = [
        [ROOM, OTHER_ROOM],
        [NOWHERE],
        [SkillCall(Skill.MOVE, object_index=99)],
        [OTHER_ROOM, NOWHERE],
    ] * 5
    reward = RewardSettings(
        unparsable=-2.0, format=0.3, relevance_per_object=0.7, relevance_limit=0.9, goal=7.1
    )
    with RealCluster(tmp_path, audit=True) as cluster:
        cluster.start_manager()
        start(cluster, program, "javascript")
        cluster.start_real_worker("python")
        async with cluster.client() as client:
            await connected(client, "javascript", "python")
            for task_id in ("tidy_up", TASK):
                terms = RunTerms(GroupPolicy.PARTIAL, verified=True, reward=reward)
                batch = await opened(client, bundle, plans, task_id, task_id, terms)
                results = await outcomes(client, batch)
                held = {"tidy_up": 1, TASK: 0}[task_id]
                atoms = len(results[0].outcome.reward.atoms)
                assert tally(batch, results, reward=0.3 + 7.1 * held / atoms).clean
            audited = await trusted(client, "javascript", "python")
    assert min(audited) == 2 * len(plans)


async def test_integers_of_64_bits_survive(tmp_path, program, bundle):
    """Epochs of a manager after 2^30 restarts, indices at both ends, seeds above 2^63."""
    plans = [[SkillCall(Skill.OPEN, object_index=index)] for index in (LARGEST, SMALLEST, -1, 2**53 + 1)] * 5
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        async with cluster.client() as client:
            await connected(client)
        cluster.signal("manager")
        with closing(sqlite3.connect(tmp_path / "state.sqlite")) as state, state:
            state.execute("UPDATE manager SET epoch = ?", (2**30,))
        cluster.start_manager()
        start(cluster, program, "w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = await opened(client, bundle, plans)
            results = await executed_despite_a_killed_manager(cluster, client, batch, after=8)
    assert tally(batch, results, reward=0.5).clean
    sent = {rollout.rollout_id: rollout.plan for rollout in batch.rollouts}
    for result in results:
        (step,) = result.outcome.steps
        assert (step.call,) == sent[result.rollout_id]
        assert step.failure is FailureReason.UNKNOWN_INDEX
        assert f"there is no object with index {step.call.object_index}:" in step.message


async def test_worker_joins_once_and_returns_with_its_credential(tmp_path, program, bundle):
    with RealCluster(tmp_path, token="operators-secret") as cluster:
        cluster.start_manager()
        async with cluster.client(token="operators-secret") as client:
            await connected(client)
            token, _ = await client.issue_token(AccessRole.JOIN)
            for _ in range(2):
                start(cluster, program, "w1", EMBOMATRIX_TOKEN=token)
                await connected(client, "w1")
                cluster.signal("w1")
            assert (tmp_path / "w1.credential").stat().st_mode & 0o777 == 0o600
            start(cluster, program, "w2", EMBOMATRIX_TOKEN=token)
            assert await asyncio.to_thread(cluster.processes["w2"].wait, 20) == 1
            assert "ask the operator for another" in cluster.log("w2")


async def test_unsupported_skill_fails_the_rollout_and_unknown_room_fails_the_step(tmp_path, program, bundle):
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        start(cluster, program, "w1")
        async with cluster.client() as client:
            await connected(client, "w1")
            batch = await opened(client, bundle, [[ROOM, NOWHERE, ROOM], [PICK_UP]])
            results = {result.rollout_id: result.outcome for result in await outcomes(client, batch)}
    walked, lost = results["r0"], results["r1"]
    assert isinstance(walked, Completed)
    assert [step.failure for step in walked.steps] == [None, FailureReason.UNKNOWN_ROOM]
    assert "the rooms are" in walked.steps[1].message
    assert lost.code is InfraCode.SLOT_CRASHED
    assert "this worker does not support SKILL_KIND_PICK_UP" in lost.message
