"""State journal for later managers: present workers, reputations, look-ahead windows, and the dispatch pause."""

import asyncio
import contextlib
import logging
from typing import Final

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.events import ReputationsKnown
from embomatrix.manager.runtime.registry import Registry
from embomatrix.manager.runtime.serialization import reputation_of, reputation_row, window_row
from embomatrix.manager.store.protocol import Namespace, NamespaceRow, StateError, StateStore
from embomatrix.rpc.status import UnavailableError

logger = logging.getLogger(__name__)

WRITE_S: Final = 0.5
"""Interval between two writes, unless one is urgent."""
NOTED_S: Final = 2.0
"""Limit of a joining worker's wait for its journal entry; workers also join while the store is away."""
_DISPATCH: Final = "dispatch"
_PAUSED: Final = b"paused"


class StateJournal:
    """Writes beside the decisions and never delays them. Failed writes are repeated when the store is back."""

    def __init__(self, store: StateStore, registry: Registry, cluster: ClusterState) -> None:
        self._store = store
        self._registry = registry
        self._dispatcher = cluster.dispatcher
        self._windows = cluster.scheduler.windows
        self._announced: dict[str, int] = {}
        """Version of the journaled window of each run."""
        self._present: frozenset[str] | None = None
        self._written = asyncio.Event()
        """Set after the next write of the present workers."""
        self._urgent = asyncio.Event()

    async def reputations(self) -> ReputationsKnown:
        """Return the reputations that former managers stored."""
        rows = await self._store.rows(Namespace.REPUTATIONS)
        return ReputationsKnown({row.key: reputation_of(row) for row in rows})

    async def paused(self) -> bool:
        """Return True if an operator paused dispatch and did not resume it."""
        return NamespaceRow(_DISPATCH, _PAUSED) in await self._store.rows(Namespace.SWITCHES)

    async def note_pause(self, paused: bool) -> None:
        """Store the pause. Raises UnavailableError if that fails: the pause then holds for this process only."""
        row = NamespaceRow(_DISPATCH, _PAUSED if paused else b"")
        try:
            await self._store.put_rows(Namespace.SWITCHES, [row])
        except StateError as error:
            done = "paused" if paused else "resumed"
            raise UnavailableError(
                f"dispatch is {done}, but not stored for other managers ({error}): repeat the command when the store is back"
            ) from error

    def flush(self) -> None:
        """Write changes now, such as a worker's quarantine."""
        self._urgent.set()

    async def wait_until_noted(self, worker_id: str) -> None:
        """Return after the worker is journaled, so that a later manager waits for it.

        It gets no lease earlier, since a later manager would re-dispatch it at once. Workers that join together are
        journaled together.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(NOTED_S):
                while worker_id not in (self._present or ()):
                    self.flush()
                    await self._written.wait()

    async def serve(self) -> None:
        """Write changes until cancelled, and once more at the end."""
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(WRITE_S):
                        await self._urgent.wait()
                self._urgent.clear()
                try:
                    await self._note_present()
                    await self._note_reputations()
                    await self._note_windows()
                except Exception:
                    logger.exception("state not journaled, the next attempt is in %g s", WRITE_S)
        finally:
            await self._note_reputations()
            await self._note_windows()

    async def _note_present(self) -> None:
        """Store the workers that a later manager must wait for."""
        present = self._registry.present | self._dispatcher.expected
        if present != self._present:
            with contextlib.suppress(StateError):
                await self._store.put_workers(present)
                self._present = present
                self._written.set()
                self._written = asyncio.Event()

    async def _note_windows(self) -> None:
        """Store windows that changed, so that preloading continues under a later manager."""
        now = {run_id: window.version for run_id, window in self._windows.items()}
        rows = [
            window_row(run_id, self._windows[run_id])
            for run_id, version in now.items()
            if self._announced.get(run_id) != version
        ]
        if not rows:
            return
        with contextlib.suppress(StateError):
            await self._store.put_rows(Namespace.WINDOWS, rows)
            self._announced = now

    async def _note_reputations(self) -> None:
        auditor = self._dispatcher.auditor
        changed = auditor.take_changed()
        rows = [reputation_row(worker_id, auditor.of(worker_id)) for worker_id in changed]
        if not rows:
            return
        try:
            await self._store.put_rows(Namespace.REPUTATIONS, rows)
        except StateError:
            auditor.note(*changed)
