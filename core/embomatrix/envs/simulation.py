"""Places where the episodes of a dataset's tasks are executed: this process, or a cluster."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.reward.settings import PAPER
from embomatrix.rpc.episodes import Episodes
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import LookaheadEntry, RunTerms

if TYPE_CHECKING:
    from embomatrix.reward.settings import RewardSettings
    from embomatrix.reward.turns import RunningEpisode
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.world.dataset import Dataset, TaskRecord

RUN_NAME: Final = "episodes"
QUIET_S: Final = 3600.0
"""After so long without a turn, the next episode begins in a new run: the manager closes runs that are idle for hours."""

logger = logging.getLogger(__name__)


class Simulation(Protocol):
    """Executes episodes, any number side by side. Equal episodes have equal turns everywhere on one platform."""

    reward: RewardSettings
    """Coefficients of the reward."""
    scenes: int
    """Scenes to use at a time: with more, they would be loaded again and again."""

    async def open(self) -> None:
        """Begin, before anything else. Raises ClusterError if the manager refuses."""

    async def begin(self, record: TaskRecord, seed: int, *, sight: bool) -> RunningEpisode:
        """Begin an episode of a task."""

    async def announce(self, steps: Sequence[Sequence[TaskRecord]], count: int) -> None:
        """Say which tasks the coming steps play, ``count`` episodes of each, so that their scenes are loaded by then.

        Replaces what was announced before.
        """

    async def close(self) -> None:
        """Free the simulators, or close the run on the cluster."""


class ClusterSimulation:
    """One run of a cluster. ``connect`` returns a client of its manager."""

    scenes = 32

    def __init__(
        self, dataset: Dataset, connect: Callable[[], ClusterClient], reward: RewardSettings = PAPER
    ) -> None:
        self.reward = reward
        self._dataset = dataset
        self._connect = connect
        self._stack = contextlib.AsyncExitStack()
        self._run = contextlib.AsyncExitStack()
        """Context of the run: its end closes the run."""
        self._opening = asyncio.Lock()
        self._sent: set[str] = set()
        self._announced = 0

    async def open(self) -> None:
        self._client = await self._stack.enter_async_context(self._connect())
        await self._open_run()

    async def _open_run(self) -> None:
        self._run_id = await self._client.open_run(RUN_NAME, terms=RunTerms(reward=self.reward))
        self._run.push_async_callback(self._client.close_run, self._run_id)
        self._episodes = await self._run.enter_async_context(Episodes(self._client, self._run_id))
        self._sent.clear()

    async def begin(self, record: TaskRecord, seed: int, *, sight: bool) -> RunningEpisode:
        async with self._opening:
            if time.monotonic() - self._episodes.used_s > QUIET_S:
                with contextlib.suppress(ClusterError):  # the manager may have closed it
                    await self._run.aclose()
                await self._open_run()
        await self._send(record.bundle_digest)
        return self._episodes.begin(record.bundle_digest, record.task.task_id, seed, sight=sight)

    async def announce(self, steps: Sequence[Sequence[TaskRecord]], count: int) -> None:
        """A rejection is only logged: the announcement is advice."""
        self._announced += 1
        version = self._announced
        entries = [
            LookaheadEntry(step, record.bundle_digest, count)
            for step, records in enumerate(steps)
            for record in records
        ]
        try:
            for entry in entries:
                await self._send(entry.bundle_digest)
            await self._client.announce_lookahead(self._run_id, version, entries)
        except ClusterError as error:
            logger.warning("look-ahead rejected: %s", error)

    async def _send(self, digest: str) -> None:
        if digest not in self._sent:
            await self._client.put_bundles({digest: self._dataset.bundle_bytes(digest)})
            self._sent.add(digest)

    async def close(self) -> None:
        try:
            await self._run.aclose()
        finally:
            await self._stack.aclose()
