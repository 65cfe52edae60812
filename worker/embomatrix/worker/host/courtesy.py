"""Watches the machine for its owner's sake: has the worker pause, hand back what it can't finish, and go on."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING

from embomatrix.worker.host.pausing import WORKING, judge
from embomatrix.worker.host.spare_memory import SCARCE_MEMORY

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.worker.host.machine import Probe
    from embomatrix.worker.host.pausing import Observation, PauseState
    from embomatrix.worker.host.preferences import Preferences
    from embomatrix.worker.slots.pool import SlotPool

logger = logging.getLogger(__name__)


class Courtesy:
    """``on_pause`` is told each new reason, and an empty one when work goes on; ``on_hand_back``, that leases were dropped
    which the manager must hear of, to give them to others."""

    def __init__(
        self,
        wishes: Preferences,
        probe: Probe,
        pool: SlotPool,
        *,
        on_pause: Callable[[str], None],
        on_hand_back: Callable[[], None],
    ) -> None:
        self._wishes = wishes
        self._probe = probe
        self._pool = pool
        self._on_pause = on_pause
        self._on_hand_back = on_hand_back
        self._standing = WORKING

    @property
    def reason(self) -> str:
        """Why the worker is paused; empty while it works."""
        return self._standing.reason

    async def run(self) -> None:
        """Look and act until cancelled."""
        if self._wishes.indifferent:
            await asyncio.Event().wait()
        while True:
            self.heed(await asyncio.to_thread(self._probe.observe), time.monotonic())
            await asyncio.sleep(self._wishes.check_s)

    def heed(self, seen: Observation, now_s: float) -> None:
        """Act on one observation, made at ``now_s`` of the monotonic clock."""
        before, self._standing = self._standing, judge(self._standing, seen, self._wishes, now_s)
        reason = self._standing.reason
        if reason != before.reason:
            logger.info("paused: %s" if reason else "going on%s", reason)
            if reason:
                self._pool.rest()
            else:
                self._pool.go_on()
            self._on_pause(reason)
        elif reason:
            # Not in the moment of the pause: what is on its way here was given before the manager could know.
            self._hand_back(self._standing, now_s)
        if reason and seen.free_memory < SCARCE_MEMORY:
            self._pool.shed()

    def _hand_back(self, standing: PauseState, now_s: float) -> None:
        """Drop what waits, and what still runs when its grace is over."""
        held = set(self._pool.held())
        if now_s - standing.since_s < self._wishes.grace_s:
            held -= {progress.ref for progress in self._pool.progress()}
        if held:
            logger.info("handing %d leases back", len(held))
            self._pool.cancel(held)
            self._on_hand_back()
