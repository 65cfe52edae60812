"""Steps done, one counter for each slot, in memory that the daemon shares with every process of its simulator.

Counting a step is a write of eight bytes: no message, no system call, nothing that the daemon would have to wake up for.
It needs nothing but the standard library: the simulator's root takes it before it forks.
"""

from __future__ import annotations

import mmap
import os
import struct
import weakref
from typing import Final

from embomatrix.host.anonymous_memory import nameless_file

_COUNTER: Final = struct.Struct("=Q")


class ProgressBoard:
    """Counters of the slots 1 to ``slots``; 0 is nobody's. Used by one daemon, and by its simulator's processes."""

    def __init__(self, fd: int) -> None:
        """The board behind the descriptor, which stays open for whoever is to inherit it, until the board goes."""
        self.fd = fd
        weakref.finalize(self, os.close, fd)
        self._memory = mmap.mmap(fd, os.fstat(fd).st_size)

    @classmethod
    def create(cls, slots: int) -> ProgressBoard:
        """A new one, in memory only where the system offers that."""
        return cls(nameless_file("progress", (slots + 1) * _COUNTER.size))

    def set(self, slot: int, steps: int) -> None:
        _COUNTER.pack_into(self._memory, slot * _COUNTER.size, steps)

    def steps(self, slot: int) -> int:
        """Steps that the slot's rollout has done."""
        return int(_COUNTER.unpack_from(self._memory, slot * _COUNTER.size)[0])
