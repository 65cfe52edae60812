"""What serving costs the manager itself: its share of the CPU time, how late its clock ticks, how long its store takes."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from embomatrix.manager.observe.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Mapping

WINDOW_S: Final = 60.0
OPERATIONS: Final = 64
"""Kinds of operations that a store may have; more would be a defect."""


class _Sample(NamedTuple):
    """At a time of the monotonic clock: CPU time of the manager and of the slots so far, in seconds."""

    at_s: float
    manager_s: float
    slots_s: float


class Effort:
    """Told by the runtime, every few seconds and with every operation."""

    def __init__(self) -> None:
        self.lag = Histogram()
        """Seconds by which a tick came late: more than a few hundredths mean that the event loop is full."""
        self._store: dict[str, Histogram] = {}
        self._samples: deque[_Sample] = deque()

    @property
    def store(self) -> Mapping[str, Histogram]:
        """Seconds that the store's operations took, by name."""
        return self._store

    def operated(self, operation: str, seconds: float) -> None:
        """An operation of the store took so long."""
        if operation in self._store or len(self._store) < OPERATIONS:
            self._store.setdefault(operation, Histogram()).observe(seconds)

    def sample(self, now_s: float, manager_s: float, slots_s: float) -> None:
        """CPU time so far. A slot executes on one core, so its time in a rollout is its CPU time."""
        self._samples.append(_Sample(now_s, manager_s, slots_s))
        while len(self._samples) > 2 and self._samples[1].at_s <= now_s - WINDOW_S:
            self._samples.popleft()

    def overhead(self) -> float:
        """The manager's part of the CPU time that it and the slots used in the last minute; 0 when nothing ran."""
        if len(self._samples) < 2:
            return 0.0
        first, last = self._samples[0], self._samples[-1]
        manager_s, slots_s = last.manager_s - first.manager_s, last.slots_s - first.slots_s
        return manager_s / (manager_s + slots_s) if slots_s > 0 else 0.0
