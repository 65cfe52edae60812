"""Contenders: our cluster, a process pool, Ray and Celery on Redis, all behind one protocol.

A library runs processes that have loaded every scene and take chunks of rollouts from one queue.
"""

import asyncio
import concurrent.futures
import contextlib
import logging
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from embomatrix.bench.cluster.cpu import running_slot
from embomatrix.bench.cluster.load_generator import LoadGenerator, load_generator
from embomatrix.bench.cluster.processes import BenchCluster, bench_cluster, redis_server, running_program
from embomatrix.bench.engine.workload import Workload
from embomatrix.bench.peers.scene_process import Answer, execute_chunk
from embomatrix.proto.v1 import types_pb2
from embomatrix.rpc.wire.outcome import completed_from_proto
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.values import Completed, Rollout

RolloutChunk = tuple[Rollout, ...]
"""Rollouts that are sent together."""
Take = Callable[["Done | Lost"], None]
StartContender = Callable[["ContenderSetup"], AbstractContextManager["Contender"]]

CLUSTER_LIMIT_S: Final = 120.0
"""Limit for the whole life of our cluster."""
OBJECT_STORE_BYTES: Final = 100 * 1024 * 1024
"""Ray's object store: results have some kilobytes each."""
CELERY_POLL_S: Final = 0.001
"""Interval at which Celery looks for results; the default of half a second would be the latency of a single rollout."""


@dataclass(frozen=True, slots=True)
class ContenderSetup:
    """Processes to start. ``folder`` holds the bundles; processes load ``preload`` first."""

    folder: Path
    slots: int
    preload: tuple[str, ...]

    def arguments(self, chunk: RolloutChunk) -> tuple[Any, ...]:
        """Arguments of ``execute_chunk`` for the chunk."""
        requests = [rollout_to_proto(rollout).SerializeToString() for rollout in chunk]
        return str(self.folder), self.preload, requests


@dataclass(frozen=True, slots=True)
class Done:
    """Results from one process. ``repeated`` counts executions beyond the first that the contender reports."""

    pid: int
    results: tuple[Completed, ...]
    repeated: int = 0


@dataclass(frozen=True, slots=True)
class Lost:
    """Rollouts that the contender gave up."""

    count: int
    reason: str


class Contender(Protocol):
    """Executes chunks in processes that it has started."""

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        """Submit all chunks at once and report each as soon as it is done or lost; return after ``limit_s`` at the latest."""

    def victim(self, pids: Sequence[int]) -> int:
        """Process id of an executing process, to be killed. ``pids`` have answered already."""
        return pids[-1]


class FuturesContender(Contender):
    """Library with futures: ``submit(chunk)`` returns one."""

    def __init__(self, submit: Callable[[RolloutChunk], concurrent.futures.Future[Answer]]) -> None:
        self._submit = submit

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        futures = {}
        for chunk in chunks:
            try:
                futures[self._submit(chunk)] = chunk
            except BrokenProcessPool as error:
                take(Lost(len(chunk), type(error).__name__))
        with contextlib.suppress(TimeoutError):
            for future in concurrent.futures.as_completed(futures, timeout=limit_s):
                failure = future.exception()
                size = len(futures[future])
                take(Lost(size, type(failure).__name__) if failure else _done(future.result()))


@contextlib.contextmanager
def process_pool(setup: ContenderSetup) -> Iterator[Contender]:
    """`ProcessPoolExecutor` with spawned processes: its documentation warns of forking a process with threads.

    It has no retry. After the death of a process it is broken, and all that it had is lost.
    """
    pool = concurrent.futures.ProcessPoolExecutor(
        setup.slots, mp_context=multiprocessing.get_context("spawn")
    )

    def submit(chunk: RolloutChunk) -> concurrent.futures.Future[Answer]:
        return pool.submit(execute_chunk, *setup.arguments(chunk))

    try:
        yield FuturesContender(submit)
    finally:
        # A broken pool of Python 3.11 may wait for its own processes without end.
        closing = threading.Thread(target=pool.shutdown, daemon=True)
        closing.start()
        closing.join(10.0)


@contextlib.contextmanager
def ray_tasks(setup: ContenderSetup) -> Iterator[Contender]:
    """Ray tasks on this machine, retried three times as by default."""
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(
        address="local",
        num_cpus=setup.slots,
        include_dashboard=False,
        object_store_memory=OBJECT_STORE_BYTES,
        log_to_driver=False,
        logging_level=logging.ERROR,
        _temp_dir=str(setup.folder),
    )
    remote = ray.remote(num_cpus=1)(execute_chunk)

    def submit(chunk: RolloutChunk) -> concurrent.futures.Future[Answer]:
        future: concurrent.futures.Future[Answer] = remote.remote(*setup.arguments(chunk)).future()
        return future

    try:
        yield FuturesContender(submit)
    finally:
        ray.shutdown()


@contextlib.contextmanager
def celery_on_redis(setup: ContenderSetup) -> Iterator[Contender]:
    """Celery worker of prefork processes on a real redis-server. Raise BenchError if none is installed."""
    from embomatrix.bench.peers.celery_app import BROKER, application

    with redis_server(setup.folder, "--save", "") as redis:
        os.environ[BROKER] = redis.url
        worker = (sys.executable, "-m", "celery", "-A", "embomatrix.bench.peers.celery_app", "worker")
        options = (f"--concurrency={setup.slots}", "--loglevel=ERROR")
        quiet = ("--without-gossip", "--without-mingle", "--without-heartbeat")
        # A new application: connections of an earlier one lead to a Redis that has ended.
        with (
            running_program(setup.folder, "celery", *worker, *options, *quiet),
            application(redis.url) as app,
        ):
            yield CeleryContender(setup, app)


class CeleryContender(Contender):
    """Submits chunks as tasks of a Celery application."""

    def __init__(self, setup: ContenderSetup, app: Any) -> None:
        self._setup = setup
        self._app = app

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        from celery.exceptions import TimeoutError as CeleryTimeoutError
        from celery.result import ResultSet

        submitted = {}
        for chunk in chunks:
            result = self._app.tasks[execute_chunk.__name__].apply_async(self._setup.arguments(chunk))
            submitted[result.id] = (result, chunk)
        answers = ResultSet([result for result, _ in submitted.values()])
        with contextlib.suppress(CeleryTimeoutError):
            for task_id, answer in answers.iter_native(timeout=limit_s, interval=CELERY_POLL_S):
                result, chunk = answer["result"], submitted[task_id][1]
                failed = answer["status"] != "SUCCESS"
                take(Lost(len(chunk), type(result).__name__) if failed else _done(result))


@contextlib.contextmanager
def own_cluster(setup: ContenderSetup, workload: Workload) -> Iterator[Contender]:
    """Manager and one worker, driven over gRPC, with the scenes of the workload warm."""
    deadline_s = time.monotonic() + CLUSTER_LIMIT_S
    with (
        bench_cluster(setup.folder, workers=1, slots=setup.slots, deadline_s=deadline_s) as cluster,
        asyncio.Runner() as runner,
    ):
        stack = contextlib.AsyncExitStack()
        opened = load_generator(cluster, workload.bundles, CLUSTER_LIMIT_S)
        try:
            load = runner.run(stack.enter_async_context(opened))
            runner.run(load.warm_up(workload.rollouts))
            yield ClusterContender(cluster, runner, load)
        finally:
            runner.run(stack.aclose())


class ClusterContender(Contender):
    """Submits all chunks as one batch, which the dispatcher distributes."""

    def __init__(self, cluster: BenchCluster, runner: asyncio.Runner, load: LoadGenerator) -> None:
        self._runner = runner
        self._load = load
        self._cluster = cluster

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        rollouts = [rollout for chunk in chunks for rollout in chunk]

        async def submit() -> None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limit_s):
                    async for arrival in self._load.stream(rollouts):
                        outcome, repeated = arrival.result.outcome, max(0, arrival.result.attempt - 1)
                        take(
                            Done(0, (outcome,), repeated)
                            if isinstance(outcome, Completed)
                            else Lost(1, type(outcome).__name__)
                        )

        self._runner.run(submit())

    def victim(self, pids: Sequence[int]) -> int:
        return running_slot(self._cluster)


def _done(answer: Answer) -> Done:
    """Decode a process's answer: a trainer needs values, not bytes."""
    pid, results = answer
    parse = types_pb2.Completed.FromString
    return Done(pid, tuple(completed_from_proto(parse(data)) for data in results))
