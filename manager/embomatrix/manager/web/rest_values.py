"""Responses of the REST API.

FastAPI evaluates the annotations for the OpenAPI page, so this module has no postponed annotations.
"""

from dataclasses import dataclass
from typing import Final

from embomatrix.manager.observe.training_reports import TrainingView
from embomatrix.manager.web.cluster_view import Health, LookaheadStep, Overview, Snapshot, WorkerView
from embomatrix.rpc.timeline import Span, slot_spans
from embomatrix.rpc.wire.run_log import EventPage
from embomatrix.rpc.wire.values import RunInfo

PAGE: Final = 100
"""Default number of rows on a page."""
LARGEST_PAGE: Final = 1000
TRACKS: Final = 200
"""Slots of a timeline at most, the first by name."""
TROUBLE: Final = ("quarantined", "lost", "suspect", "draining", "paused")
"""States that are listed first, in this order. Workers that left come last."""


@dataclass(frozen=True, slots=True)
class WorkerPage:
    """Page of workers from ``offset``; ``total`` counts all that match."""

    at_s: float
    total: int
    offset: int
    items: list[WorkerView]


@dataclass(frozen=True, slots=True)
class RunPage:
    """Page of runs from ``offset``; ``at_s`` is seconds since the epoch."""

    at_s: float
    total: int
    offset: int
    items: list[RunInfo]


@dataclass(frozen=True, slots=True)
class SnapshotPage:
    """State of the cluster at one moment, with one page of its workers."""

    at_s: float
    health: Health
    paused: bool
    overview: Overview
    workers: WorkerPage
    runs: list[RunInfo]
    lookahead: list[LookaheadStep]
    training: list[TrainingView]


@dataclass(frozen=True, slots=True)
class SlotSpan:
    """Work of a slot on one rollout. Times are seconds since the epoch on the manager's clock."""

    begin_s: float
    end_s: float
    load_s: float
    outcome: str
    rollout_id: str
    bundle_digest: str
    attempt: int
    deliver_s: float


@dataclass(frozen=True, slots=True)
class SlotTrack:
    """Work of one slot of a worker, in the order of time."""

    worker_id: str
    slot: int
    spans: list[SlotSpan]


@dataclass(frozen=True, slots=True)
class Timeline:
    """Work of each slot between two moments, from the event log. ``dropped`` events were discarded for later ones.

    ``slots`` counts the slots with work; ``tracks`` holds the first of them.
    """

    run_id: str
    from_s: float
    until_s: float
    dropped: int
    slots: int
    tracks: list[SlotTrack]


@dataclass(frozen=True, slots=True)
class Changed:
    """Result of a command."""

    thing: str
    state: str


def worker_page(
    seen: Snapshot, *, state: str = "", search: str = "", offset: int = 0, limit: int = PAGE
) -> WorkerPage:
    """Return a page of the workers in the state, with the text in their name or a label. Workers with trouble come first."""
    found = [
        worker for worker in seen.workers if state in ("", worker.state) and search.lower() in _words(worker)
    ]
    found.sort(key=_urgency)
    return WorkerPage(seen.at_s, len(found), offset, found[offset : offset + limit])


def run_page(seen: Snapshot, *, offset: int = 0, limit: int = PAGE) -> RunPage:
    """Return a page of the open runs, newest first."""
    newest = seen.runs[::-1]
    return RunPage(seen.at_s, len(newest), offset, newest[offset : offset + limit])


def _words(worker: WorkerView) -> str:
    """Return the text that a search covers."""
    return " ".join([worker.worker_id, *(f"{name}={value}" for name, value in worker.labels.items())]).lower()


def _urgency(worker: WorkerView) -> tuple[int, str]:
    order = TROUBLE.index(worker.state) if worker.state in TROUBLE else len(TROUBLE)
    return order + (worker.state == "left"), worker.worker_id


def snapshot_page(seen: Snapshot, *, state: str, search: str, offset: int, limit: int) -> SnapshotPage:
    return SnapshotPage(
        seen.at_s,
        seen.health,
        seen.paused,
        seen.overview,
        worker_page(seen, state=state, search=search, offset=offset, limit=limit),
        seen.runs,
        seen.lookahead,
        seen.training,
    )


def timeline(run_id: str, page: EventPage, *, seconds: float, search: str = "") -> Timeline:
    """Return the last seconds before the latest event, for workers with the text in their name."""
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
