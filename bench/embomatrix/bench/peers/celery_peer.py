"""Celery on Redis in the contest: a worker of prefork processes for each queue, and a real redis-server."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING, Any, Final

from celery.exceptions import TimeoutError as CeleryTimeoutError
from celery.result import ResultSet

from embomatrix.bench.cluster.processes import running_program
from embomatrix.bench.cluster.redis import redis_server
from embomatrix.bench.peers.celery_app import BROKER, FRESH, HELD, application
from embomatrix.bench.peers.contender import LibraryMode, Lost, done_from

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from celery import Celery

    from embomatrix.bench.peers.contender import ContenderSetup, Done, RolloutChunk, Take

INTERVAL_S: Final = 0.001
"""Celery looks for results this often; by default twice a second, which would be the latency of a rollout alone."""
APP: Final = "embomatrix.bench.peers.celery_app"


@contextlib.contextmanager
def celery_on_redis(setup: ContenderSetup) -> Iterator[CeleryContender]:
    """Redis and the workers for as long as the context lasts. Raises BenchError where no redis-server is found."""
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(redis_server(setup.folder, "--save", "")).url
        os.environ[BROKER] = broker
        for lane in range(setup.lanes):
            queue = f"lane-{lane}"
            stack.enter_context(
                running_program(
                    setup.folder,
                    queue,
                    *(sys.executable, "-m", "celery", "-A", APP, "worker", f"--queues={queue}"),
                    *(f"--hostname={queue}@bench", f"--concurrency={setup.processes_each}"),
                    *("--without-gossip", "--without-mingle", "--without-heartbeat", "--loglevel=ERROR"),
                )
            )
        # An application of its own: a former one's connections lead to a Redis that is gone.
        with application(broker) as made:
            yield CeleryContender(setup, made)


class CeleryContender:
    """Submits chunks as tasks."""

    def __init__(self, setup: ContenderSetup, made: Celery) -> None:
        self._setup = setup
        self._application = made

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        results = {}
        for chunk in chunks:
            result = self._submit(chunk)
            results[result.id] = (result, chunk)
        answers = ResultSet([result for result, _ in results.values()])
        try:
            for task_id, answer in answers.iter_native(timeout=limit_s, interval=INTERVAL_S):
                take(_news(answer, results[task_id][1]))
        except CeleryTimeoutError:
            return

    def victim(self, pids: Sequence[int]) -> int:
        return pids[-1]

    def _submit(self, chunk: RolloutChunk) -> Any:
        queue, folder = f"lane-{chunk.lane}", str(self._setup.folder)
        if self._setup.mode is LibraryMode.PLAIN:
            return self._application.tasks[FRESH].apply_async((folder, *chunk.requests), queue=queue)
        request = (folder, self._setup.preload, chunk.requests)
        return self._application.tasks[HELD].apply_async(request, queue=queue)


def _news(answer: dict[str, Any], chunk: RolloutChunk) -> Done | Lost:
    result = answer["result"]
    if answer["status"] != "SUCCESS":
        return Lost(len(chunk.rollouts), type(result).__name__)
    return done_from(result)
