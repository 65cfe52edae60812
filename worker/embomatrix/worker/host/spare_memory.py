"""Leaves others memory: what scenes may hold shrinks while the machine has little left, and grows again with it.

A worker measures its machine once, when it starts. Whoever starts later, an owner's programs, a trainer or further workers,
would else find memory promised twice, until the system kills one of them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.host.cgroup import MIB, find_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.worker.slots.pool import SlotPool

SCARCE_MEMORY: Final = 0.1
"""With less of the memory available than this share, scenes are given up."""
CHECK_S: Final = 2.0


class SpareMemory:
    """Watches for ``pool``. ``spare_mb`` gives the memory that may still be taken; below 0, so much is to be given back."""

    def __init__(self, pool: SlotPool, spare_mb: Callable[[], float] | None = None) -> None:
        self._pool = pool
        self._spare_mb = spare_mb or spare_memory_mb

    async def run(self, check_s: float = CHECK_S) -> None:
        """Look and act until cancelled."""
        while True:
            self._pool.allow(max(0.0, self._pool.memory_used_mb + self._spare_mb()))
            await asyncio.sleep(check_s)


def spare_memory_mb() -> float:
    """What may be taken of this machine and of the control groups around this process, until memory is scarce."""
    memory = psutil.virtual_memory()
    left_mb: float = (memory.available - SCARCE_MEMORY * memory.total) / MIB
    return min(left_mb, find_limits().memory_mb)
