"""Work intervals of each slot, reconstructed from the arrival times and durations of results."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from embomatrix.rpc.wire.run_log import EventKind, RunEvent


class SlotKey(NamedTuple):
    """Slot in the cluster; the slots of a worker count from 1."""

    worker_id: str
    slot: int


@dataclass(frozen=True, slots=True)
class Span:
    """Work of a slot on a lease from ``begin_s`` to ``end_s``, in seconds since the epoch on the manager's clock."""

    event: RunEvent
    begin_s: float
    end_s: float

    @property
    def load_s(self) -> float:
        """Time that the lease waited for its scene, before the span."""
        return self.event.timings.load_s if self.event.timings is not None else 0.0


def slot_spans(events: Iterable[RunEvent]) -> dict[SlotKey, list[Span]]:
    """Return the work of each slot in order; spans of a slot do not overlap.

    Workers report durations only, and results may arrive in bulk. The end of a span is therefore the earlier of the
    result's arrival and the begin of the slot's next span.
    """
    by_slot: dict[SlotKey, list[RunEvent]] = {}
    for event in events:
        if event.slot and event.kind in (EventKind.COMPLETED, EventKind.FAILED):
            by_slot.setdefault(SlotKey(event.worker_id, event.slot), []).append(event)
    return {key: _placed(by_slot[key]) for key in sorted(by_slot)}


def busy_share(
    spans: Mapping[SlotKey, Sequence[Span]], first_s: float, step_s: float, steps: int
) -> list[float]:
    """Return the share of these slots that worked in each step, 0 to 1."""
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
