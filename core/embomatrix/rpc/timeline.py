"""When each slot was at work, as far as the manager can tell from when results came and how long they took."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from embomatrix.rpc.wire.run_log import EventKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from embomatrix.rpc.wire.run_log import RunEvent


class SlotKey(NamedTuple):
    """A slot in the cluster; slots of a worker count from 1."""

    worker_id: str
    slot: int


@dataclass(frozen=True, slots=True)
class Span:
    """A slot worked on a lease from ``begin_s`` to ``end_s``, in seconds since the epoch on the manager's clock."""

    event: RunEvent
    begin_s: float
    end_s: float

    @property
    def load_s(self) -> float:
        """How long before it the lease waited for its scene."""
        return self.event.timings.load_s if self.event.timings is not None else 0.0


def slot_spans(events: Iterable[RunEvent]) -> dict[SlotKey, list[Span]]:
    """The work of each slot in order; no two spans of a slot overlap.

    Only durations come from a worker, and results may come many at a time, so an end is known by two bounds: not after the
    result's arrival, and not after the beginning of what the slot did next. The latest time within both is taken.
    """
    by_slot: dict[SlotKey, list[RunEvent]] = {}
    for event in events:
        if event.slot and event.kind in (EventKind.COMPLETED, EventKind.FAILED):
            by_slot.setdefault(SlotKey(event.worker_id, event.slot), []).append(event)
    return {key: _placed(by_slot[key]) for key in sorted(by_slot)}


def busy_share(
    spans: Mapping[SlotKey, Sequence[Span]], first_s: float, step_s: float, steps: int
) -> list[float]:
    """The share of these slots that worked in each step, 0 to 1."""
    busy_s = [0.0] * steps
    for span in itertools.chain.from_iterable(spans.values()):
        begin, end = (span.begin_s - first_s) / step_s, (span.end_s - first_s) / step_s
        for step in range(max(0, math.floor(begin)), min(steps, math.ceil(end))):
            busy_s[step] += max(0.0, min(end, step + 1) - max(begin, step)) * step_s
    return [min(1.0, seconds / (step_s * max(1, len(spans)))) for seconds in busy_s]


def _placed(events: Sequence[RunEvent]) -> list[Span]:
    spans: list[Span] = []
    next_s = math.inf
    for event in reversed(events):
        execute_s = event.timings.execute_s if event.timings is not None else 0.0
        end_s = min(event.at_s, next_s)
        next_s = end_s - max(event.held_s, execute_s)
        spans.append(Span(event, next_s, end_s))
    return spans[::-1]
