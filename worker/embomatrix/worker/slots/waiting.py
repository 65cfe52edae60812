"""Queue of leases that wait for a slot, in order of arrival except that leases of a scene with an idle slot may overtake."""

import functools
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Final

from embomatrix.worker.slots.execution import HeldLease
from embomatrix.worker.slots.residents import ResidentScene

OVERTAKEN_S: Final = 0.5
"""A lease that has waited this long is not overtaken."""


class WaitingLeases:
    """Waiting leases of ``slots`` slots; ``warm`` returns the scene of a bundle digest if it can execute."""

    def __init__(self, slots: int, warm: Callable[[str], ResidentScene | None]) -> None:
        self._slots = slots
        self._warm = warm
        self._queue: deque[HeldLease] = deque()

    def __iter__(self) -> Iterator[HeldLease]:
        """Iterate from the first lease of the queue."""
        return iter(self._queue)

    def add(self, held: HeldLease) -> None:
        self._queue.append(held)

    def put_back(self, leases: Iterable[HeldLease]) -> None:
        """Put leases back in front of the queue, in their order."""
        self._queue.extendleft(reversed(list(leases)))

    def remove(self, held: HeldLease) -> None:
        """Remove a lease. Raise ValueError if it does not wait."""
        self._queue.remove(held)

    def take_of(self, digest: str) -> list[HeldLease]:
        """Take all leases of one scene."""
        return self._take([held for held in self._queue if held.digest == digest])

    def take(self, now_s: float) -> tuple[HeldLease, ResidentScene] | None:
        """Take the next lease of a warm scene, with the scene.

        It is the first one. Until that has waited long, it is the first one that needs no fork beside a busy slot: a process
        spends most on copied pages and adaptation in its first rollouts, so few processes with many rollouts are cheaper.
        """
        warm = ((held, scene) for held in self._queue if (scene := self._warm(held.digest)) is not None)
        first = next(warm, None)
        if first is None:
            return None
        found = first
        if not first[1].needs_no_fork and now_s - first[0].taken_s <= OVERTAKEN_S:
            found = next((pair for pair in warm if pair[1].needs_no_fork), first)
        self._queue.remove(found[0])
        return found

    def take_more(self, scene: ResidentScene, count: int, now_s: float) -> list[HeldLease]:
        """Take up to ``count`` leases of this warm scene, at most a slot's share of the queue.

        They may overtake leases of other scenes, until one of these has waited long.
        """
        count = min(count, len(self._queue) // self._slots)
        if count <= 0 or self._warm(scene.digest) is not scene:
            return []
        late = now_s - self._queue[0].taken_s > OVERTAKEN_S
        fits = functools.partial(HeldLease.fits, digest=scene.digest)
        found = itertools.takewhile(fits, self._queue) if late else filter(fits, self._queue)
        return self._take(list(itertools.islice(found, count)))

    def _take(self, leases: list[HeldLease]) -> list[HeldLease]:
        for held in leases:
            self._queue.remove(held)
        return leases
