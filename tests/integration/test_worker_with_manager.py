"""Real manager and worker processes: kills lose no rollout."""

import asyncio
import contextlib
import signal
import subprocess
import sys
import time
import zlib
from collections import Counter
from pathlib import Path

import psutil
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Batch, Completed, InfraFailure, LookaheadEntry, Rollout, Warmth
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.inflation import bundle_digest

FAKES = Path(__file__).parents[1] / "fakes"
LIMITS = ClientLimits(retry_first_s=0.05, retry_longest_s=0.5)


class Cluster:
    """Processes of one cluster, started and ended by the test."""

    def __init__(self, folder):
        self.folder = folder
        self.port = free_port()
        self.address = f"127.0.0.1:{self.port}"
        self.processes = {}

    def start_manager(self):
        self._start(
            "manager",
            *(
                "-m",
                "embomatrix.cli",
                "manager",
                "serve",
                f"--port={self.port}",
                f"--http-port={free_port()}",
            ),
            *(f"--state=sqlite:{self.folder / 'state.sqlite'}", f"--data-dir={self.folder / 'manager'}"),
        )

    def start_worker(self, name, slots=2):
        """Start a daemon with the physics-free simulation."""
        self._start(
            name, str(FAKES / "worker_process.py"), self.address, name, str(self.folder / name), str(slots)
        )

    def start_real_worker(self, name, slots=1):
        self._start(
            name,
            *("-m", "embomatrix.cli", "worker", "run", f"--manager={self.address}", f"--name={name}"),
            *(f"--slots={slots}", f"--cache-dir={self.folder / name}", "--nice=0"),
        )

    def kill(self, name):
        """Send SIGKILL: the process cannot clean up."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def stop(self):
        for process in self.processes.values():
            process.kill()
            process.wait()

    def log(self, name):
        return (self.folder / f"{name}.log").read_text()

    def _start(self, name, *arguments):
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen([sys.executable, *arguments], stdout=log, stderr=log)


@contextlib.asynccontextmanager
async def cluster(folder, *workers, real=False):
    """Start a manager and these connected workers, and a client."""
    made = Cluster(folder)
    try:
        made.start_manager()
        for name in workers:
            (made.start_real_worker if real else made.start_worker)(name)
        async with ClusterClient(made.address, limits=LIMITS) as client:
            await _connected(client, *workers)
            yield made, client
    finally:
        made.stop()


async def _connected(client, *names, limit_s=60.0):
    async with asyncio.timeout(limit_s):
        while True:
            with contextlib.suppress(ClusterError):
                ready = {
                    worker.worker_id for worker in await client.list_workers() if worker.state == "ready"
                }
                if ready >= set(names):
                    return
            await asyncio.sleep(0.05)


def _batch(run_id, digests, count, task="ok", batch_id="b1"):
    rollouts = tuple(
        Rollout(f"r{number}", f"g{number // 8}", digests[number % len(digests)], task, (), number // 8)
        for number in range(count)
    )
    return Batch(run_id, batch_id, 0, rollouts)


async def _put(client, *contents):
    packed = [zlib.compress(content) for content in contents]
    bundles = {bundle_digest(content): content for content in packed}
    await client.put_bundles(bundles)
    return list(bundles)


async def test_batch_over_two_workers_comes_back_complete(tmp_path):
    async with cluster(tmp_path, "w1", "w2") as (_, client):
        digests = await _put(client, b"ok", b"ok ")
        run_id = await client.open_run("test")
        results = [result async for result in client.execute(_batch(run_id, digests, 200), deadline_s=60.0)]
        stats = await client.close_run(run_id)
    assert Counter(result.rollout_id for result in results) == Counter(f"r{number}" for number in range(200))
    assert all(isinstance(result.outcome, Completed) for result in results)
    assert stats.delivered == 200
    assert stats.infra_failures == 0


async def test_announced_scene_is_warm_before_it_is_needed(tmp_path):
    async with cluster(tmp_path, "w1") as (_, client):
        [digest] = await _put(client, b"ok")
        run_id = await client.open_run("test")
        entries = [LookaheadEntry(1, digest, 8)]
        async with asyncio.timeout(20):
            version = 1
            while (await client.announce_lookahead(run_id, version, entries))[digest] is not Warmth.WARM:
                version += 1
                await asyncio.sleep(0.05)
        results = [result async for result in client.execute(_batch(run_id, [digest], 8), deadline_s=30.0)]
    assert all(result.outcome.warm for result in results)


async def test_result_that_a_manager_would_refuse_fails_its_rollout_and_not_the_worker(tmp_path):
    async with cluster(tmp_path, "w1") as (made, client):
        [digest] = await _put(client, b"ok")
        run_id = await client.open_run("test")
        for task, kind in (("endless", InfraFailure), ("long", Completed)):
            batch = _batch(run_id, [digest], 1, task, batch_id=task)
            (result,) = [result async for result in client.execute(batch, deadline_s=60.0)]
            assert isinstance(result.outcome, kind)
            if kind is InfraFailure:
                assert "the result can't be sent: outcome: found 120," in result.outcome.message
        assert made.processes["w1"].poll() is None


async def test_worker_killed_in_the_middle_costs_no_rollout(tmp_path):
    async with cluster(tmp_path, "w1", "w2") as (made, client):
        digests = await _put(client, b"ok", b"ok ")
        run_id = await client.open_run("test")
        results = []
        async for result in client.execute(_batch(run_id, digests, 40, task="slow"), deadline_s=120.0):
            results.append(result)
            if len(results) == 8:
                made.kill("w1")
        stats = await client.close_run(run_id)
    assert Counter(result.rollout_id for result in results) == Counter(f"r{number}" for number in range(40))
    assert all(isinstance(result.outcome, Completed) for result in results)
    assert stats.redispatched > 0


async def test_manager_killed_in_the_middle_costs_no_rollout(tmp_path):
    async with cluster(tmp_path, "w1", "w2") as (made, client):
        digests = await _put(client, b"ok")
        run_id = await client.open_run("test")
        results = []
        async for result in client.execute(_batch(run_id, digests, 40, task="slow"), deadline_s=120.0):
            results.append(result)
            if len(results) == 8:
                made.kill("manager")
                made.start_manager()
    assert Counter(result.rollout_id for result in results) == Counter(f"r{number}" for number in range(40))
    assert all(isinstance(result.outcome, Completed) for result in results)


async def test_crashes_are_infrastructure_failures_without_rewards(tmp_path):
    async with cluster(tmp_path, "w1") as (_, client):
        [digest] = await _put(client, b"ok")
        run_id = await client.open_run("test")
        for task in ("crash", "raise"):
            batch = _batch(run_id, [digest], 4, task=task, batch_id=task)
            results = [result async for result in client.execute(batch, deadline_s=60.0)]
            assert len(results) == 4
            assert not any(isinstance(result.outcome, Completed) for result in results)
        good = _batch(run_id, [digest], 4, batch_id="good")
        results = [result async for result in client.execute(good, deadline_s=60.0)]
    assert all(isinstance(result.outcome, Completed) for result in results)


async def test_drained_worker_leaves_and_the_other_finishes(tmp_path):
    async with cluster(tmp_path, "w1", "w2") as (made, client):
        [digest] = await _put(client, b"ok")
        run_id = await client.open_run("test")
        results = []
        async for result in client.execute(_batch(run_id, [digest], 40, task="slow"), deadline_s=120.0):
            results.append(result)
            if len(results) == 4:
                made.processes["w1"].send_signal(signal.SIGTERM)
        left = await asyncio.to_thread(made.processes["w1"].wait, 20)
        stats = await client.close_run(run_id)
    assert left == 0, made.log("w1")
    assert all(isinstance(result.outcome, Completed) for result in results)
    assert len(results) == 40
    assert stats.redispatched == 0


async def test_two_workers_of_one_name_settle(tmp_path):
    async with cluster(tmp_path, "w1") as (made, client):
        made.processes["first"] = made.processes.pop("w1")
        made.start_worker("w1")
        started_s = time.monotonic()
        async with asyncio.timeout(60):
            while all(process.poll() is None for process in made.processes.values()):  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        assert time.monotonic() - started_s < 60
        await _connected(client, "w1")
    assert "another worker of that name is running" in made.log("w1")


async def test_no_simulator_outlives_a_killed_worker(tmp_path):
    async with cluster(tmp_path, "w1") as (made, client):
        [digest] = await _put(client, b"ok")
        run_id = await client.open_run("test")
        [result async for result in client.execute(_batch(run_id, [digest], 8), deadline_s=60.0)]
        children = psutil.Process(made.processes["w1"].pid).children(recursive=True)
        assert len(children) >= 3
        made.kill("w1")
        assert psutil.wait_procs(children, timeout=5)[1] == []


def _kitchen():
    """Return the flat with its tasks as a real bundle, and a sensible plan for each task."""
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    movable = [item.name for item in scene.objects if not item.fixed]
    supports = [item.name for item in scene.objects if item.fixed]
    data = encode_bundle(Bundle(scene, tasks, build_pose_cache(scene, movable, supports, seed=0)))
    index = tasks["apple_to_counter"].index_of
    apple, counter = index["apple_1"], index["countertop_1"]
    plan = (
        SkillCall(Skill.MOVE, object_index=apple),
        SkillCall(Skill.PICK_UP, object_index=apple),
        SkillCall(Skill.MOVE, object_index=counter),
        SkillCall(Skill.PLACE, object_index=counter, relation=PlaceRelation.ONTOP),
    )
    return data, plan


async def test_every_plan_is_scored_once_though_a_worker_is_killed(tmp_path):
    data, plan = _kitchen()
    failing = (SkillCall(Skill.PICK_UP, object_index=99),)
    digest = bundle_digest(data)
    rollouts = tuple(
        Rollout(
            f"r{number}",
            f"g{number // 8}",
            digest,
            "apple_to_counter",
            failing if number % 4 == 3 else plan,
            number // 8,
        )
        for number in range(160)
    )
    async with cluster(tmp_path, "w1", "w2", real=True) as (made, client):
        await client.put_bundles({digest: data})
        run_id = await client.open_run("test")
        results = []
        async for result in client.execute(Batch(run_id, "b1", 0, rollouts), deadline_s=120.0):
            results.append(result)
            if len(results) == 20:
                made.kill("w1")
        await client.close_run(run_id)
    assert Counter(result.rollout_id for result in results) == Counter(
        rollout.rollout_id for rollout in rollouts
    )
    assert all(isinstance(result.outcome, Completed) for result in results)
    by_id = {result.rollout_id: result.outcome for result in results}
    for number in range(160):
        outcome = by_id[f"r{number}"]
        if number % 4 == 3:
            assert outcome.steps[0].failure is FailureReason.UNKNOWN_INDEX
            assert outcome.reward.total == 0.5
        else:
            assert outcome.reward.success
            assert outcome.reward.total > 30
            # One group, one seed, one plan: one trace, whichever worker executed it.
            assert outcome.trace_digest == by_id[f"r{number // 8 * 8}"].trace_digest
