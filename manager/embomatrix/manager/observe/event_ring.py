"""The latest events of one log: a ring with a count of what it dropped."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from embomatrix.rpc.run_log import EventPage

if TYPE_CHECKING:
    from embomatrix.rpc.run_log import RunEvent


class EventRing:
    """Events by rising sequence. ``limit`` may be changed; the oldest make room."""

    __slots__ = ("dropped", "events", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.dropped = 0
        self.events: deque[RunEvent] = deque()

    def append(self, event: RunEvent) -> None:
        self.events.append(event)
        while len(self.events) > self.limit:
            self.events.popleft()
            self.dropped += 1

    def after(self, sequence: int, limit: int) -> EventPage:
        """The first events beyond the sequence."""
        found: list[RunEvent] = []
        for event in self.events:
            if event.sequence > sequence:
                found.append(event)
                if len(found) == limit:
                    break
        return EventPage(tuple(found), self.dropped)
