"""Run log: events in the order in which the manager saw them, their summary, and their conversion to and from protobuf.

Times are seconds since the epoch on the manager's clock. Durations are measured by the side that spends them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.wire.codec import ConvertError, converters, each, enum_numbers, finite, inside
from embomatrix.rpc.wire.outcome import timings_from_proto, timings_to_proto
from embomatrix.rpc.wire.session import run_info_from_proto, run_info_to_proto
from embomatrix.rpc.wire.values import RunInfo, Timings

LEAST_WORK_S: Final = 3.0
"""Work of all slots below which the manager's share of CPU time says nothing: its idle time would count."""


class RolloutPhase(StrEnum):
    """Phases of a rollout, in order."""

    QUEUE = "queue"
    LEASE = "lease"
    LOAD = "load"
    EXECUTE = "execute"
    DELIVER = "deliver"


class EventKind(StrEnum):
    """Kind of an event."""

    RUN_OPENED = "run_opened"
    RUN_CLOSED = "run_closed"
    SUBMITTED = "submitted"
    LEASED = "leased"
    COMPLETED = "completed"
    FAILED = "failed"
    ENDED = "ended"
    WORKER_JOINED = "worker_joined"
    WORKER_LOST = "worker_lost"
    SCENE_WARM = "scene_warm"
    SCENE_EVICTED = "scene_evicted"
    SCENE_FAILED = "scene_failed"


class RunEvent(NamedTuple):
    """One event. Fields that do not apply are empty; ``proto/admin_service`` lists the fields of each kind."""

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
class PhaseSummary:
    """Durations of one phase. Quantiles have an error of at most 4 %."""

    count: int = 0
    sum_s: float = 0.0
    p50_s: float = 0.0
    p95_s: float = 0.0
    p99_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RunWorker:
    """Work of one worker for a run: completed and failed leases, and the seconds spent on them."""

    worker_id: str
    completed: int = 0
    failed: int = 0
    execute_s: float = 0.0
    load_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RunSeries:
    """Rollouts by outcome in each interval of ``step_s`` seconds since the run was opened."""

    step_s: float
    completed: tuple[int, ...]
    failed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Totals of a run. ``manager_cpu_s`` is the manager's CPU time during the run, spent on all runs."""

    run: RunInfo
    phases: Mapping[RolloutPhase, PhaseSummary]
    workers: tuple[RunWorker, ...]
    series: RunSeries
    failures: tuple[RunEvent, ...]
    """Latest failures, oldest first."""
    manager_cpu_s: float
    prewarm_lead: PhaseSummary
    scene_load: PhaseSummary
    events_dropped: int
    version: str

    @property
    def overhead(self) -> float | None:
        """Manager's share of the CPU time of manager and slots; None if the slots hardly worked."""
        slots_s = self.phases.get(RolloutPhase.EXECUTE, PhaseSummary()).sum_s
        return self.manager_cpu_s / (self.manager_cpu_s + slots_s) if slots_s >= LEAST_WORK_S else None


class RolloutStepKind(StrEnum):
    """Kinds of steps in the history of a rollout."""

    SUBMITTED = "submitted"
    QUEUED = "queued"
    LEASED = "leased"
    HEDGED = "hedged"
    REVOKED = "revoked"
    EXPIRED = "expired"
    RETURNED = "returned"
    HELD = "held"
    DELIVERED = "delivered"


class RolloutStep(NamedTuple):
    """One step in the history of a rollout. ``cause`` names the event that led to it."""

    at_s: float
    kind: str
    """A ``RolloutStepKind``, or a kind of a newer manager."""
    run_id: str
    batch_id: str
    worker_id: str
    reason: str
    cause: str


@dataclass(frozen=True, slots=True)
class RolloutExplanation:
    """Recent history of a rollout. ``place`` is empty once it has its outcome."""

    steps: tuple[RolloutStep, ...]
    place: str


@dataclass(frozen=True, slots=True)
class EventPage:
    """Events in order. ``dropped`` counts the log's events that were discarded for later ones."""

    events: tuple[RunEvent, ...]
    dropped: int


run_event_to_proto, run_event_from_proto = converters(
    RunEvent,
    pb.RunEvent,
    enums={"kind": enum_numbers(EventKind, pb.EventKind, "EVENT_KIND")},
    parts={"timings": (timings_to_proto, timings_from_proto)},
    absent={"timings": None},
)
event_page_to_proto, event_page_from_proto = converters(
    EventPage, pb.ReadEventsResponse, parts={"events": (run_event_to_proto, run_event_from_proto)}
)
_step_to_proto, _step_from_proto = converters(RolloutStep, pb.RolloutStep)
explanation_to_proto, explanation_from_proto = converters(
    RolloutExplanation, pb.ExplainRolloutResponse, parts={"steps": (_step_to_proto, _step_from_proto)}
)
_phase_to_proto, _phase_from_proto = converters(PhaseSummary, pb.PhaseSummary)
_worker_to_proto, _worker_from_proto = converters(RunWorker, pb.RunWorker)
_series_to_proto, _read_series = converters(RunSeries, pb.RunSeries)


def run_summary_to_proto(summary: RunSummary) -> pb.GetRunResponse:
    message = pb.GetRunResponse(
        run=run_info_to_proto(summary.run),
        workers=map(_worker_to_proto, summary.workers),
        series=_series_to_proto(summary.series),
        failures=map(run_event_to_proto, summary.failures),
        manager_cpu_s=summary.manager_cpu_s,
        prewarm_lead=_phase_to_proto(summary.prewarm_lead),
        scene_load=_phase_to_proto(summary.scene_load),
        events_dropped=summary.events_dropped,
        version=summary.version,
    )
    for phase, found in summary.phases.items():
        message.phases.add(phase=phase.value).MergeFrom(_phase_to_proto(found))
    return message


def run_summary_from_proto(message: pb.GetRunResponse) -> RunSummary:
    return RunSummary(
        run=inside("run", run_info_from_proto, message.run),
        phases=dict(each("phases", _named_phase_from_proto, message.phases)),
        workers=each("workers", _worker_from_proto, message.workers),
        series=inside("series", _series_from_proto, message.series),
        failures=each("failures", run_event_from_proto, message.failures),
        manager_cpu_s=finite("manager_cpu_s", message.manager_cpu_s),
        prewarm_lead=inside("prewarm_lead", _phase_from_proto, message.prewarm_lead),
        scene_load=inside("scene_load", _phase_from_proto, message.scene_load),
        events_dropped=message.events_dropped,
        version=message.version,
    )


def _named_phase_from_proto(message: pb.PhaseSummary) -> tuple[RolloutPhase, PhaseSummary]:
    if message.phase not in list(RolloutPhase):
        raise ConvertError("phase", f"found {message.phase!r}: expected one of {', '.join(RolloutPhase)}")
    return RolloutPhase(message.phase), _phase_from_proto(message)


def _series_from_proto(message: pb.RunSeries) -> RunSeries:
    if finite("step_s", message.step_s) <= 0:
        raise ConvertError("step_s", f"found {message.step_s}: expected a number above 0")
    return _read_series(message)
