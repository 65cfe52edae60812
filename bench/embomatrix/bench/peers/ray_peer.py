"""Ray in the contest.

Plain: a task for each rollout. Shared: tasks on processes that Ray keeps, each with its scenes. Affine: actors that hold
scenes, each with its own queue. Chunks, as its patterns advise against fine-grained tasks. Actors restart and their calls are
tried again without limit, tasks three times as by default.
"""

from __future__ import annotations

import contextlib
import logging
import os
from typing import TYPE_CHECKING, Any, Final

import ray

from embomatrix.bench.peers.contender import LibraryMode, follow
from embomatrix.bench.peers.engine_pool import SceneProcess, execute_fresh, execute_held

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.bench.peers.contender import ContenderSetup, RolloutChunk, Take
    from embomatrix.bench.peers.engine_pool import Answer

STORE_BYTES: Final = 100 * 1024 * 1024
"""Results of some kilobytes each pass by the object store: a small one will do."""


@contextlib.contextmanager
def ray_cluster(setup: ContenderSetup) -> Iterator[RayContender]:
    """Ray on this machine for as long as the context lasts."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(
        address="local",
        num_cpus=setup.slots,
        include_dashboard=False,
        object_store_memory=STORE_BYTES,
        log_to_driver=False,
        logging_level=logging.ERROR,
        _temp_dir=str(setup.folder),
    )
    try:
        yield RayContender(setup)
    finally:
        ray.shutdown()


class SceneActor:
    """Holds scenes and executes chunks."""

    def __init__(self, folder: str, digests: Sequence[str]) -> None:
        self._holder = SceneProcess(folder, digests)

    def answer(self, requests: Sequence[bytes]) -> Answer:
        return self._holder.answer(requests)


class RayContender:
    """Submits chunks to tasks or actors."""

    def __init__(self, setup: ContenderSetup) -> None:
        self._setup = setup
        folder, preload = str(setup.folder), setup.preload
        self._fresh = ray.remote(num_cpus=1)(execute_fresh)
        self._held = ray.remote(num_cpus=1)(execute_held)
        actor = ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=-1)(SceneActor)
        count = setup.slots if setup.mode is LibraryMode.AFFINE else 0
        self._actors = [actor.remote(folder, preload) for _ in range(count)]

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        follow({self._submit(chunk).future(): chunk for chunk in chunks}, take, limit_s)

    def victim(self, pids: Sequence[int]) -> int:
        return pids[-1]

    def _submit(self, chunk: RolloutChunk) -> Any:
        folder = str(self._setup.folder)
        match self._setup.mode:
            case LibraryMode.PLAIN:
                return self._fresh.remote(folder, *chunk.requests)
            case LibraryMode.SHARED:
                return self._held.remote(folder, self._setup.preload, chunk.requests)
            case LibraryMode.AFFINE:
                return self._actors[chunk.lane].answer.remote(chunk.requests)
