"""Simulated time and network: an event queue, and paths that delay, reorder nothing, and may be cut."""

import heapq
import itertools
from collections.abc import Callable


class EventQueue:
    """Actions in order of time, and of insertion at equal times. ``now_s`` is in seconds since the simulation began."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Schedule an action ``delay_s`` seconds from now."""
        heapq.heappush(self._due, (self.now_s + max(delay_s, 0.0), next(self._order), action))

    def run(self, *, until: Callable[[], bool], limit_s: float) -> bool:
        """Run actions until the condition holds; False if ``limit_s`` or the end of the queue comes first."""
        while not until():
            if not self._due or self._due[0][0] > limit_s:
                return False
            self.now_s, _, action = heapq.heappop(self._due)
            action()
        return True


class NetworkPath:
    """Path between a worker and the manager. Messages of an ended connection never arrive."""

    def __init__(self, queue: EventQueue, latency_s: float) -> None:
        self.latency_s = latency_s
        self._queue = queue
        self._connection = 0
        self._up_s = self._down_s = 0.0
        """Arrival of the last message in each direction: messages keep their order."""
        self._up_cut_s = self._down_cut_s = 0.0

    def up(self, arrive: Callable[[], None]) -> None:
        """Send to the manager."""
        self._up_s = self._send(arrive, self._up_s, self._up_cut_s)

    def down(self, arrive: Callable[[], None]) -> None:
        """Send to the worker."""
        self._down_s = self._send(arrive, self._down_s, self._down_cut_s)

    def cut(self, seconds: float, *, up: bool, down: bool) -> None:
        """Cut the path for ``seconds``. Messages sent meanwhile are retransmitted and arrive afterwards."""
        end_s = self._queue.now_s + seconds
        if up:
            self._up_cut_s = max(self._up_cut_s, end_s)
        if down:
            self._down_cut_s = max(self._down_cut_s, end_s)

    def hang_up(self) -> None:
        """End the connection; messages under way are lost."""
        self._connection += 1

    def _send(self, arrive: Callable[[], None], after_s: float, cut_s: float) -> float:
        now_s, connection = self._queue.now_s, self._connection
        at_s = max(after_s, max(now_s, cut_s) + self.latency_s)

        def deliver() -> None:
            if connection == self._connection:
                arrive()

        self._queue.after(at_s - now_s, deliver)
        return at_s
