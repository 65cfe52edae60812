"""Leader election: of several managers on one store one leads, the others stand by until its leader lease lapses."""

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

from embomatrix.manager.store.protocol import (
    Candidate,
    FencedError,
    Namespace,
    NamespaceRow,
    StateError,
    StateStore,
)

logger = logging.getLogger(__name__)

RENEWALS: Final = 3
ATTEMPTS: Final = 6
"""Renewals by the leader, and attempts by each standby, during the life of a leader lease."""


class Leadership:
    """Role of one manager in the election. A leader that was replaced exits; its supervisor restarts it as a standby."""

    def __init__(self, store: StateStore, candidate: Candidate) -> None:
        self._store = store
        self._candidate = candidate
        self._renewed_s = -float("inf")
        self._problem = ""

    def lapsed_s(self) -> float:
        """Return the seconds in which another manager may have led, since this one could not renew; 0 while it leads."""
        return max(0.0, time.monotonic() - self._renewed_s - self._candidate.ttl_s)

    def problem(self) -> str:
        """Return the reason why the last renewal failed; empty after a success."""
        return self._problem

    async def win(self, on_standby: Callable[[str], Awaitable[None]]) -> int:
        """Wait until this manager leads and return its epoch. ``on_standby`` receives each leader's address until
        then.

        Raises StateError if the store is away at the start; later failures are retried.
        """
        known = ""
        lead = await self._store.claim(self._candidate)
        while not lead.mine:
            if lead.address != known:
                known = lead.address
                await on_standby(known)
                logger.info("standing by: the manager at %s leads", known)
            await asyncio.sleep(self._candidate.ttl_s / ATTEMPTS)
            try:
                lead = await self._store.claim(self._candidate)
            except StateError as error:
                # The former leader gets the first chance when the store is back, since its lease lapsed with the
                # store.
                logger.warning("standing by, and the store is away: %s", error)
                await asyncio.sleep(self._candidate.ttl_s)
        self._renewed_s = time.monotonic()
        logger.info("leading under epoch %d", lead.epoch)
        return lead.epoch

    async def keep(self) -> None:
        """Renew the leader lease until cancelled. Raises FencedError after another manager took over."""
        pause_s = self._candidate.ttl_s / RENEWALS
        while True:
            await asyncio.sleep(pause_s)
            asked_s = time.monotonic()
            try:
                await self._store.renew()
            except FencedError:
                raise
            except StateError as error:
                self._problem = str(error)
                logger.warning("leader lease not renewed: %s", error)
            else:
                self._renewed_s, self._problem = asked_s, ""


MARK: Final = "folder-id"
_KEY: Final = "data_folder"
_LEASE_KEY: Final = "lease_key"
LEASE_KEY_BYTES: Final = 32


async def warn_of_another_folder(store: StateStore, folder: Path) -> None:
    """Log a warning if the last leader had another data folder. Raises StateError or OSError.

    Managers of one state share a data folder, since bundles are files there. Each folder has a random id in a file,
    and the leader notes it in the state.
    """
    noted = {row.key: row.payload for row in await store.rows(Namespace.SWITCHES)}.get(_KEY)
    if noted is not None and noted != _mark_of(folder):
        logger.warning(
            "the data folder %s differs from that of the last leader on this state: bundles of its runs are missing here, "
            "and their rollouts would fail. Give all managers of a state the same --data-dir, such as a network share",
            folder,
        )


async def note_folder(store: StateStore, folder: Path) -> None:
    """Note this manager's data folder in the state. Raises StateError or OSError."""
    await store.put_rows(Namespace.SWITCHES, [NamespaceRow(_KEY, _mark_of(folder))])


async def lease_key(store: StateStore) -> bytes:
    """Return the cluster's secret for lease ids. The first leader creates it. Raises StateError."""
    known = {row.key: row.payload for row in await store.rows(Namespace.SWITCHES)}.get(_LEASE_KEY)
    if known is None:
        known = secrets.token_bytes(LEASE_KEY_BYTES)
        await store.put_rows(Namespace.SWITCHES, [NamespaceRow(_LEASE_KEY, known)])
    return known


def _mark_of(folder: Path) -> bytes:
    """Return the id of the folder, creating it on first use."""
    file = folder / MARK
    with contextlib.suppress(FileExistsError), file.open("xb") as made:
        made.write(secrets.token_hex(16).encode())
    return file.read_bytes()
