"""A run's log and summary to wire messages and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.run_log import (
    EventKind,
    EventPage,
    PhaseSummary,
    RolloutExplanation,
    RolloutPhase,
    RolloutStep,
    RolloutStepKind,
    RunEvent,
    RunSeries,
    RunSummary,
    RunWorker,
)
from embomatrix.rpc.wire.outcome import timings_from_proto, timings_to_proto
from embomatrix.rpc.wire.rollout import ConvertError, each, finite, inside
from embomatrix.rpc.wire.session import run_info_from_proto, run_info_to_proto

if TYPE_CHECKING:
    from collections.abc import Mapping

_KINDS: Final[Mapping[EventKind, pb.EventKind.ValueType]] = {
    kind: pb.EventKind.Value(f"EVENT_KIND_{kind.name}") for kind in EventKind
}
_KIND_VALUES: Final = {number: kind for kind, number in _KINDS.items()}
_PLAIN: Final = tuple(name for name in RunEvent._fields if name not in ("kind", "timings"))


def run_event_to_proto(event: RunEvent) -> pb.RunEvent:
    message = pb.RunEvent(kind=_KINDS[event.kind], **{name: getattr(event, name) for name in _PLAIN})
    if event.timings is not None:
        message.timings.CopyFrom(timings_to_proto(event.timings))
    return message


def run_event_from_proto(message: pb.RunEvent) -> RunEvent:
    kind = _KIND_VALUES.get(message.kind)
    if kind is None:
        raise ConvertError("kind", f"{message.kind} is no known kind: is the sender newer than this side?")
    finite("at_s", message.at_s)
    finite("held_s", message.held_s)
    timings = inside("timings", timings_from_proto, message.timings) if message.HasField("timings") else None
    return RunEvent(kind=kind, timings=timings, **{name: getattr(message, name) for name in _PLAIN})


def event_page_to_proto(page: EventPage) -> pb.ReadEventsResponse:
    return pb.ReadEventsResponse(events=map(run_event_to_proto, page.events), dropped=page.dropped)


def event_page_from_proto(message: pb.ReadEventsResponse) -> EventPage:
    return EventPage(each("events", run_event_from_proto, message.events), message.dropped)


def explanation_to_proto(found: RolloutExplanation) -> pb.ExplainRolloutResponse:
    steps = (pb.RolloutStep(**step._asdict()) for step in found.steps)
    return pb.ExplainRolloutResponse(steps=steps, place=found.place)


def explanation_from_proto(message: pb.ExplainRolloutResponse) -> RolloutExplanation:
    return RolloutExplanation(each("steps", _rollout_step_from_proto, message.steps), message.place)


def _rollout_step_from_proto(message: pb.RolloutStep) -> RolloutStep:
    finite("at_s", message.at_s)
    try:
        kind = RolloutStepKind(message.kind)
    except ValueError as error:
        raise ConvertError("kind", f"{message.kind!r} is no known step: upgrade this side") from error
    texts = (message.run_id, message.batch_id, message.worker_id, message.reason, message.cause)
    return RolloutStep(message.at_s, kind, *texts)


def run_summary_to_proto(summary: RunSummary) -> pb.GetRunResponse:
    return pb.GetRunResponse(
        run=run_info_to_proto(summary.run),
        phases=[_phase_to_proto(phase.value, found) for phase, found in summary.phases.items()],
        workers=[
            pb.RunWorker(**{name: getattr(worker, name) for name in RunWorker.__slots__})
            for worker in summary.workers
        ],
        series=pb.RunSeries(
            step_s=summary.series.step_s, completed=summary.series.completed, failed=summary.series.failed
        ),
        failures=map(run_event_to_proto, summary.failures),
        manager_cpu_s=summary.manager_cpu_s,
        prewarm_lead=_phase_to_proto("", summary.prewarm_lead),
        scene_load=_phase_to_proto("", summary.scene_load),
        events_dropped=summary.events_dropped,
        version=summary.version,
    )


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


def _phase_to_proto(phase: str, found: PhaseSummary) -> pb.PhaseSummary:
    return pb.PhaseSummary(phase=phase, **{name: getattr(found, name) for name in PhaseSummary.__slots__})


def _phase_from_proto(message: pb.PhaseSummary) -> PhaseSummary:
    return PhaseSummary(
        message.count,
        finite("sum_s", message.sum_s),
        finite("p50_s", message.p50_s),
        finite("p95_s", message.p95_s),
        finite("p99_s", message.p99_s),
    )


def _named_phase_from_proto(message: pb.PhaseSummary) -> tuple[RolloutPhase, PhaseSummary]:
    if message.phase not in list(RolloutPhase):
        raise ConvertError(
            "phase", f"{message.phase!r} is no known phase: expected one of {', '.join(RolloutPhase)}"
        )
    return RolloutPhase(message.phase), _phase_from_proto(message)


def _worker_from_proto(message: pb.RunWorker) -> RunWorker:
    return RunWorker(
        message.worker_id,
        message.completed,
        message.failed,
        finite("execute_s", message.execute_s),
        finite("load_s", message.load_s),
    )


def _series_from_proto(message: pb.RunSeries) -> RunSeries:
    if finite("step_s", message.step_s) <= 0:
        raise ConvertError("step_s", f"is {message.step_s}: it must be above 0")
    return RunSeries(message.step_s, tuple(message.completed), tuple(message.failed))
