"""Responses of the REST API.

FastAPI evaluates the annotations for the OpenAPI page, so this module has no postponed annotations.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from embomatrix.manager.observe.hosts import HostCurve
from embomatrix.manager.observe.run_story import run_story
from embomatrix.manager.observe.run_totals import RunTotal, run_totals
from embomatrix.manager.observe.training_reports import TrainingDetail, TrainingView
from embomatrix.manager.web.cluster_view import Health, LookaheadStep, Overview, Snapshot, WorkerView
from embomatrix.rpc.timeline import Span, slot_spans
from embomatrix.rpc.wire.run_log import (
    EventKind,
    EventPage,
    PhaseSummary,
    RolloutPhase,
    RunEvent,
    RunSeries,
    RunSummary,
    RunWorker,
)
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import RunInfo, Timings

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


class RunFilter(StrEnum):
    """Runs of a list."""

    OPEN = "open"
    CLOSED = "closed"
    ALL = "all"


@dataclass(frozen=True, slots=True)
class EventView:
    """Event of a log. A response has the fields that apply, and no others."""

    sequence: int
    at_s: float
    kind: EventKind
    run_id: str = ""
    batch_id: str = ""
    rollout_id: str = ""
    worker_id: str = ""
    bundle_digest: str = ""
    slot: int = 0
    attempt: int = 0
    code: str = ""
    message: str = ""
    timings: Timings | None = None
    held_s: float = 0.0
    size: int = 0


@dataclass(frozen=True, slots=True)
class EventList:
    """Page of a log. ``dropped`` events were discarded for later ones."""

    events: list[EventView]
    dropped: int


@dataclass(frozen=True, slots=True)
class RunDetail:
    """Open or closed run: its story in sentences, totals, durations by phase, work of each worker, and latest failures."""

    run: RunInfo
    story: list[str]
    totals: list[RunTotal]
    phases: dict[RolloutPhase, PhaseSummary]
    workers: list[RunWorker]
    series: RunSeries
    failures: list[EventView]
    """Latest failed leases and rollouts, oldest first."""
    manager_cpu_s: float
    """CPU time of the manager while the run was open, spent on all runs."""
    prewarm_lead: PhaseSummary
    """Time between a scene being warm and its demand."""
    scene_load: PhaseSummary
    events_dropped: int
    version: str
    """Version of the manager's software."""
    trained: bool
    """True if its trainer reported: ``training/RUN`` has curves and plans."""


@dataclass(frozen=True, slots=True)
class WorkerDetail:
    """One worker, with the last half hour of its machine."""

    at_s: float
    worker: WorkerView
    host: HostCurve


@dataclass(frozen=True, slots=True)
class WorkerLog:
    """Latest lines of a worker's log, oldest first, without secrets."""

    worker_id: str
    lines: list[str]


@dataclass(frozen=True, slots=True)
class CallerView:
    """Role of the sender's token. ``refusal`` says why it may not send commands; empty if it may."""

    role: AccessRole
    refusal: str


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


@dataclass(frozen=True, slots=True)
class Refusal:
    """Reason in one sentence why a request was refused."""

    detail: str


def worker_page(
    seen: Snapshot, *, state: str = "", search: str = "", offset: int = 0, limit: int = PAGE
) -> WorkerPage:
    """Return a page of the workers in the state, with the text in their name or a label. Workers with trouble come first."""
    found = [
        worker for worker in seen.workers if state in ("", worker.state) and search.lower() in _words(worker)
    ]
    found.sort(key=_urgency)
    return WorkerPage(seen.at_s, len(found), offset, found[offset : offset + limit])


def run_page(
    seen: Snapshot,
    closed: Sequence[RunInfo] = (),
    *,
    shown: RunFilter = RunFilter.OPEN,
    search: str = "",
    offset: int = 0,
    limit: int = PAGE,
) -> RunPage:
    """Return a page of runs with the text in their name or id: open ones, the newest first, then closed ones."""
    found = [] if shown is RunFilter.CLOSED else seen.runs[::-1]
    open_ids = {run.run_id for run in seen.runs}
    if shown is not RunFilter.OPEN:
        # A run that was closed and opened again is open.
        found = [*found, *(run for run in closed if run.run_id not in open_ids)]
    found = [run for run in found if search.lower() in f"{run.name} {run.run_id}".lower()]
    return RunPage(seen.at_s, len(found), offset, found[offset : offset + limit])


def run_detail(summary: RunSummary, training: TrainingDetail | None) -> dict[str, Any]:
    """Return the fields of a ``RunDetail``, each event with the fields that apply."""
    values = {
        field.name: getattr(summary, field.name)
        for field in dataclasses.fields(summary)
        if field.name != "failures"
    }
    return {
        "run": summary.run,
        "story": run_story(summary, training),
        "totals": run_totals(summary, training),
        **values,
        "failures": [event_fields(event) for event in summary.failures],
        "trained": training is not None,
    }


def event_fields(event: RunEvent) -> dict[str, Any]:
    """Return the event's fields that are set."""
    timings = dataclasses.asdict(event.timings) if event.timings is not None else None
    values = event._replace(timings=None)._asdict() | {"timings": timings}
    return {name: value for name, value in values.items() if value}


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
