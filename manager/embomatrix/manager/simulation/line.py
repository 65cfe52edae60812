"""The way between a worker and the manager: messages arrive in order, late, or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.manager.simulation.agenda import Agenda


class Line:
    """A network path with connections over it. What was sent on a connection that ended never arrives."""

    def __init__(self, agenda: Agenda, latency_s: float) -> None:
        self.latency_s = latency_s
        self._agenda = agenda
        self._connection = 0
        self._up_s = self._down_s = 0.0
        """When the last message of each direction arrives: no later one comes before it."""
        self._up_cut_s = self._down_cut_s = 0.0

    def up(self, arrive: Callable[[], None]) -> None:
        """Send to the manager."""
        self._up_s = self._send(arrive, self._up_s, self._up_cut_s)

    def down(self, arrive: Callable[[], None]) -> None:
        """Send to the worker."""
        self._down_s = self._send(arrive, self._down_s, self._down_cut_s)

    def cut(self, seconds: float, *, up: bool, down: bool) -> None:
        """Let nothing through for so long. What is sent meanwhile is sent again and again, and comes afterwards."""
        end_s = self._agenda.now_s + seconds
        if up:
            self._up_cut_s = max(self._up_cut_s, end_s)
        if down:
            self._down_cut_s = max(self._down_cut_s, end_s)

    def hang_up(self) -> None:
        """End the connection: whatever is under way on it is lost."""
        self._connection += 1

    def _send(self, arrive: Callable[[], None], after_s: float, cut_s: float) -> float:
        now_s, connection = self._agenda.now_s, self._connection
        at_s = max(after_s, max(now_s, cut_s) + self.latency_s)

        def deliver() -> None:
            if connection == self._connection:
                arrive()

        self._agenda.after(at_s - now_s, deliver)
        return at_s
