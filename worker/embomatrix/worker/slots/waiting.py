"""Leases that wait for a slot, in the order in which they came but for those whose scene a slot has at hand."""

from __future__ import annotations

import functools
import itertools
from collections import deque
from typing import TYPE_CHECKING, Final

from embomatrix.worker.slots.execution import Ticket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from embomatrix.worker.slots.residents import ResidentScene

OVERTAKEN_S: Final = 0.5
"""A lease that has waited for this long is not overtaken by one whose scene a slot has at hand."""


class WaitingLeases:
    """``slots`` share what waits; ``warm`` tells the scene of a bundle digest that can execute."""

    def __init__(self, slots: int, warm: Callable[[str], ResidentScene | None]) -> None:
        self._slots = slots
        self._warm = warm
        self._tickets: deque[Ticket] = deque()

    def __iter__(self) -> Iterator[Ticket]:
        """From the one whose turn it is."""
        return iter(self._tickets)

    def add(self, ticket: Ticket) -> None:
        self._tickets.append(ticket)

    def give_back(self, tickets: Iterable[Ticket]) -> None:
        """These wait again, in their order, before all others."""
        self._tickets.extendleft(reversed(list(tickets)))

    def remove(self, ticket: Ticket) -> None:
        """Raises ValueError for one that does not wait."""
        self._tickets.remove(ticket)

    def take_of(self, digest: str) -> list[Ticket]:
        """All of one scene wait no longer."""
        return self._take([ticket for ticket in self._tickets if ticket.digest == digest])

    def take(self, now_s: float) -> tuple[Ticket, ResidentScene] | None:
        """One whose scene is warm, with this.

        It is the first, or, until that has waited for long, the first for which no process must be forked beside one that is
        at work: what a process needs is copied and found out in its first rollouts, so few processes with many rollouts each
        spend less on it than many with few.
        """
        warm = (
            (ticket, scene) for ticket in self._tickets if (scene := self._warm(ticket.digest)) is not None
        )
        first = next(warm, None)
        if first is None:
            return None
        found = first
        if not first[1].at_hand and now_s - first[0].taken_s <= OVERTAKEN_S:
            found = next((pair for pair in warm if pair[1].at_hand), first)
        self._tickets.remove(found[0])
        return found

    def take_more(self, scene: ResidentScene, count: int, now_s: float) -> list[Ticket]:
        """Leases of this scene, up to a count, while it is warm: no more than a slot's share of all that wait.

        They may overtake those of other scenes, until one of these has waited for long.
        """
        count = min(count, len(self._tickets) // self._slots)
        if count <= 0 or self._warm(scene.digest) is not scene:
            return []
        late = now_s - self._tickets[0].taken_s > OVERTAKEN_S
        fits = functools.partial(Ticket.fits, digest=scene.digest)
        found = itertools.takewhile(fits, self._tickets) if late else filter(fits, self._tickets)
        return self._take(list(itertools.islice(found, count)))

    def _take(self, tickets: list[Ticket]) -> list[Ticket]:
        for ticket in tickets:
            self._tickets.remove(ticket)
        return tickets
