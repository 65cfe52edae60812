"""Places where the episodes of a dataset's tasks are executed: this process, or a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.rpc.episodes import Episodes

if TYPE_CHECKING:
    from embomatrix.reward.turns import RunningEpisode
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.world.dataset import Dataset, TaskRecord

RUN_NAME: Final = "episodes"


class Simulation(Protocol):
    """Executes episodes, any number side by side. Equal episodes have equal turns everywhere on one platform."""

    scenes: int
    """Scenes to use at a time: with more, they would be loaded again and again."""

    async def open(self) -> None:
        """Begin, before anything else. Raises ClusterError if the manager refuses."""

    async def begin(self, record: TaskRecord, seed: int, *, sight: bool) -> RunningEpisode:
        """Begin an episode of a task."""

    async def close(self) -> None:
        """Free the simulators, or close the run on the cluster."""


class ClusterSimulation:
    """One run of a cluster. ``connect`` returns a client of its manager."""

    scenes = 32

    def __init__(self, dataset: Dataset, connect: Callable[[], ClusterClient]) -> None:
        self._dataset = dataset
        self._connect = connect
        self._stack = contextlib.AsyncExitStack()
        self._sent: set[str] = set()

    async def open(self) -> None:
        self._client = await self._stack.enter_async_context(self._connect())
        run_id = await self._client.open_run(RUN_NAME)
        self._stack.push_async_callback(self._client.close_run, run_id)
        self._episodes = await self._stack.enter_async_context(Episodes(self._client, run_id))

    async def begin(self, record: TaskRecord, seed: int, *, sight: bool) -> RunningEpisode:
        digest = record.bundle_digest
        if digest not in self._sent:
            await self._client.put_bundles({digest: self._dataset.bundle_bytes(digest)})
            self._sent.add(digest)
        return self._episodes.begin(digest, record.task.task_id, seed, sight=sight)

    async def close(self) -> None:
        await self._stack.aclose()
