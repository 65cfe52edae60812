"""Yielding of a worker to its host: pauses for the owner's sake, and less memory for scenes while memory is scarce."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.host.limits import MIB, find_limits
from embomatrix.worker.host.machine import Probe
from embomatrix.worker.host.owner_policy import (
    WORKING,
    Observation,
    PauseState,
    Preferences,
    next_pause_state,
)

if TYPE_CHECKING:
    from embomatrix.worker.slots.pool import SlotPool

logger = logging.getLogger(__name__)

SCARCE_MEMORY: Final = 0.1
"""Share of the memory below which scenes are given up."""
CHECK_S: Final = 2.0


class OwnerWatch:
    """Watches the machine and pauses the pool, hands leases back, and resumes.

    ``on_pause`` gets each new reason, an empty one when work resumes. ``on_hand_back`` is called after leases were dropped,
    so that the manager can give them to other workers.
    """

    def __init__(
        self,
        preferences: Preferences,
        probe: Probe,
        pool: SlotPool,
        *,
        on_pause: Callable[[str], None],
        on_hand_back: Callable[[], None],
    ) -> None:
        self._preferences = preferences
        self._probe = probe
        self._pool = pool
        self._on_pause = on_pause
        self._on_hand_back = on_hand_back
        self._state = WORKING

    @property
    def reason(self) -> str:
        """Reason of the pause; empty while the worker works."""
        return self._state.reason

    async def run(self) -> None:
        """Observe and act until cancelled."""
        if self._preferences.always:
            await asyncio.Event().wait()
        while True:
            self.apply(await asyncio.to_thread(self._probe.observe), time.monotonic())
            await asyncio.sleep(self._preferences.check_s)

    def apply(self, seen: Observation, now_s: float) -> None:
        """Act on an observation of the time ``now_s`` of the monotonic clock."""
        before, self._state = self._state, next_pause_state(self._state, seen, self._preferences, now_s)
        reason = self._state.reason
        if reason != before.reason:
            logger.info("paused: %s" if reason else "resuming%s", reason)
            if reason:
                self._pool.pause()
            else:
                self._pool.resume()
            self._on_pause(reason)
        elif reason:
            # Not at the moment of the pause: leases on their way were given before the manager could know.
            self._hand_back(self._state, now_s)
        if reason and seen.free_memory < SCARCE_MEMORY:
            self._pool.shed()

    def _hand_back(self, state: PauseState, now_s: float) -> None:
        """Drop waiting leases, and after the grace period running ones."""
        held = set(self._pool.held())
        if now_s - state.since_s < self._preferences.grace_s:
            held -= {progress.ref for progress in self._pool.progress()}
        if held:
            logger.info("handing back leases=%d", len(held))
            self._pool.cancel(held)
            self._on_hand_back()


class MemoryWatch:
    """Adapts the memory limit of the pool's scenes to the memory that the machine has left.

    A worker measures its machine once, at its start. Programs that start later would find memory promised twice, until the
    system kills one of them. ``spare_mb`` returns the memory that may still be taken; negative values must be given back.
    """

    def __init__(self, pool: SlotPool, spare_mb: Callable[[], float] | None = None) -> None:
        self._pool = pool
        self._spare_mb = spare_mb or spare_memory_mb

    async def run(self, check_s: float = CHECK_S) -> None:
        """Observe and act until cancelled."""
        while True:
            self._pool.limit_memory(max(0.0, self._pool.memory_used_mb + self._spare_mb()))
            await asyncio.sleep(check_s)


def spare_memory_mb() -> float:
    """Memory of this machine and its control groups that may be taken before memory is scarce."""
    memory = psutil.virtual_memory()
    left_mb: float = (memory.available - SCARCE_MEMORY * memory.total) / MIB
    return min(left_mb, find_limits().memory_mb)
