"""Who leads: of several managers on one store one dispatches, the others stand by until its lead lapses."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from embomatrix.manager.store.protocol import FencedError, StateError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

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
