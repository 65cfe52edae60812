"""Who leads: of several managers on one store one dispatches, the others stand by until its lead lapses."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from typing import TYPE_CHECKING, Final

from embomatrix.manager.store.protocol import FencedError, Shelf, ShelfRow, StateError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

    from embomatrix.manager.store.protocol import Candidate, StateStore

logger = logging.getLogger(__name__)

RENEWALS: Final = 3
ATTEMPTS: Final = 6
"""In the time after which a lead lapses, the leader renews it so often, and others try so often to take it."""


class Leadership:
    """One manager's part in the election. A leader that was overtaken ends; whoever starts it again has it stand by."""

    def __init__(self, store: StateStore, candidate: Candidate) -> None:
        self._store = store
        self._candidate = candidate
        self._renewed_s = -float("inf")
        self._problem = ""

    def lapsed_s(self) -> float:
        """For how long another manager may have had the lead, since this one could not renew it; 0 while it leads."""
        return max(0.0, time.monotonic() - self._renewed_s - self._candidate.ttl_s)

    def problem(self) -> str:
        """Why the lead could not be renewed the last time; empty where it was."""
        return self._problem

    async def win(self, on_standby: Callable[[str], Awaitable[None]]) -> int:
        """Wait until this manager leads; returns its epoch. ``on_standby`` hears the address of whoever leads until then.

        Raises ``StateError`` when the store is away from the start; later it is waited for.
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
                # When the store is back, its leader comes first: its lead lapsed with the store.
                logger.warning("standing by, and the store is away: %s", error)
                await asyncio.sleep(self._candidate.ttl_s)
        self._renewed_s = time.monotonic()
        logger.info("leading under epoch %d", lead.epoch)
        return lead.epoch

    async def keep(self) -> None:
        """Renew the lead until cancelled. Ends with ``FencedError`` when another manager took it."""
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
                logger.warning("the lead could not be renewed: %s", error)
            else:
                self._renewed_s, self._problem = asked_s, ""


MARK: Final = "folder-id"
_KEY: Final = "data_folder"


async def warn_of_another_folder(store: StateStore, folder: Path) -> None:
    """Tell in the log when the manager that led last had another data folder than this one. Raises StateError, OSError."""
    noted = {row.key: row.payload for row in await store.rows(Shelf.SWITCHES)}.get(_KEY)
    if noted is not None and noted != _mark_of(folder):
        logger.warning(
            "the data folder %s is not that of the manager that led last on this state: bundles of its runs are missing "
            "here, and their rollouts would fail. Give all managers of a state one --data-dir, such as a network share",
            folder,
        )


async def note_folder(store: StateStore, folder: Path) -> None:
    """This manager leads, with this data folder. Raises StateError, OSError."""
    await store.put_rows(Shelf.SWITCHES, [ShelfRow(_KEY, _mark_of(folder))])


def _mark_of(folder: Path) -> bytes:
    """The folder's own name, which it gets when nobody asked before."""
    file = folder / MARK
    with contextlib.suppress(FileExistsError), file.open("xb") as made:
        made.write(secrets.token_hex(16).encode())
    return file.read_bytes()
