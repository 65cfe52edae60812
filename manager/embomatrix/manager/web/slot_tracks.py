"""The timeline of a run for the page: what each slot did of late."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.manager.web.rest_values import SlotSpan, SlotTrack, Timeline
from embomatrix.rpc.timeline import slot_spans

if TYPE_CHECKING:
    from embomatrix.rpc.run_log import EventPage
    from embomatrix.rpc.timeline import Span

TRACKS: Final = 200
"""More slots than a person can look at; the first of them by name."""


def timeline(run_id: str, page: EventPage, *, seconds: float, search: str = "") -> Timeline:
    """The last so many seconds before the latest event of the page, of workers with the text in their name."""
    until_s = max((event.at_s for event in page.events), default=0.0)
    from_s = until_s - seconds
    tracks = [
        SlotTrack(key.worker_id, key.slot, [_span(span) for span in spans if span.end_s >= from_s])
        for key, spans in slot_spans(page.events).items()
        if search.lower() in key.worker_id.lower()
    ]
    busy = [track for track in tracks if track.spans]
    return Timeline(run_id, from_s, until_s, page.dropped, len(busy), busy[:TRACKS])


def _span(span: Span) -> SlotSpan:
    event = span.event
    return SlotSpan(
        begin_s=span.begin_s,
        end_s=span.end_s,
        load_s=span.load_s,
        outcome=event.code or event.kind.value,
        rollout_id=event.rollout_id,
        bundle_digest=event.bundle_digest,
        attempt=event.attempt,
        deliver_s=event.timings.deliver_s if event.timings is not None else 0.0,
    )
