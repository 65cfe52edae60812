"""A run as a Chrome trace, for https://ui.perfetto.dev or chrome://tracing.

The format is Google's "Trace Event Format": complete slices (X), asynchronous slices (b, e), instants (i) and
names (M); times are microseconds.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from embomatrix.rpc.timeline import SlotKey, Span, slot_spans
from embomatrix.rpc.wire.run_log import EventKind, RunEvent

TRACE_MARK: Final = b'{"otherData":{"generator":"EmboMatrix"}'
"""First bytes of each trace."""
MANAGER: Final = 1
"""Process id of the manager's track; workers follow."""
SUBMISSION_US: Final = 1000.0
"""Drawn length of a submission, which takes no time."""

TraceEvent = dict[str, Any]


def chrome_trace(run: Sequence[RunEvent], fleet: Sequence[RunEvent], name: str) -> Mapping[str, Any]:
    """Return the trace: a track for each slot, one for submissions, and scene loads beside the slots.

    ``run`` are the events of a run, ``fleet`` those of workers and scenes; both in order.
    """
    spans = slot_spans(run)
    workers = sorted({key.worker_id for key in spans})
    processes = {worker_id: number for number, worker_id in enumerate(workers, MANAGER + 1)}
    origin_s = min((event.at_s for event in run), default=0.0)
    clock = _Clock(min([origin_s, *(track[0].begin_s - track[0].load_s for track in spans.values())]))
    events = [
        *_names(name, processes, spans),
        *_submissions(run, clock),
        *itertools.chain.from_iterable(
            _track(processes[key.worker_id], key.slot, track, clock) for key, track in spans.items()
        ),
        *_fleet(fleet, processes, clock),
    ]
    return {"otherData": {"generator": "EmboMatrix"}, "traceEvents": events, "displayTimeUnit": "ms"}


class _Clock:
    """Microseconds from the first event."""

    def __init__(self, origin_s: float) -> None:
        self._origin_s = origin_s

    def us(self, at_s: float) -> float:
        return round((at_s - self._origin_s) * 1e6, 3)


def _names(
    name: str, processes: Mapping[str, int], spans: Mapping[SlotKey, Sequence[Span]]
) -> Iterator[TraceEvent]:
    yield _meta("process_name", MANAGER, 0, f"manager: {name}")
    yield _meta("thread_name", MANAGER, 1, "submissions")
    for worker_id, process in processes.items():
        yield _meta("process_name", process, 0, f"worker {worker_id}")
    for key in spans:
        yield _meta("thread_name", processes[key.worker_id], key.slot, f"slot {key.slot}")


def _meta(kind: str, process: int, thread: int, name: str) -> TraceEvent:
    return {"ph": "M", "name": kind, "pid": process, "tid": thread, "args": {"name": name}}


def _slice(
    track: Mapping[str, int], name: str, begin_us: float, length_us: float, arguments: TraceEvent
) -> TraceEvent:
    return {"ph": "X", "name": name, "ts": begin_us, "dur": length_us, "args": arguments, **track}


def _submissions(run: Sequence[RunEvent], clock: _Clock) -> Iterator[TraceEvent]:
    submitted = [event for event in run if event.kind is EventKind.SUBMITTED]
    for event, after in itertools.zip_longest(submitted, submitted[1:]):
        begin = clock.us(event.at_s)
        length = min(SUBMISSION_US, clock.us(after.at_s) - begin) if after is not None else SUBMISSION_US
        arguments = {"batch": event.batch_id, "rollouts": event.size}
        yield _slice({"pid": MANAGER, "tid": 1}, f"submit {event.size}", begin, length, arguments)


def _track(process: int, slot: int, spans: Sequence[Span], clock: _Clock) -> Iterator[TraceEvent]:
    """Yield the slices of one slot. Gaps are split into result delivery, idle time and scene load."""
    track = {"pid": process, "tid": slot}

    def part(name: str, begin_s: float, end_s: float, arguments: TraceEvent) -> Iterator[TraceEvent]:
        begin, end = clock.us(begin_s), clock.us(end_s)
        if end > begin:
            yield _slice(track, name, begin, round(end - begin, 3), arguments)

    free_s: float | None = None
    arrived_s = 0.0
    for span in spans:
        begin_s = span.begin_s if free_s is None else max(free_s, span.begin_s)
        loading_s = begin_s - span.load_s if free_s is None else max(free_s, begin_s - span.load_s)
        if free_s is not None:
            on_its_way_s = min(max(arrived_s, free_s), loading_s)
            yield from part("deliver", free_s, on_its_way_s, {})
            yield from part("idle", on_its_way_s, loading_s, {})
        yield from part("load", loading_s, begin_s, {"scene": span.event.bundle_digest})
        failed = span.event.kind is EventKind.FAILED
        yield from part("failed" if failed else "execute", begin_s, span.end_s, _arguments(span.event))
        free_s, arrived_s = span.end_s, span.event.at_s
    if free_s is not None:
        yield from part("deliver", free_s, max(free_s, arrived_s), {})


def _arguments(event: RunEvent) -> TraceEvent:
    arguments: TraceEvent = {
        "rollout": event.rollout_id,
        "batch": event.batch_id,
        "attempt": event.attempt,
        "scene": event.bundle_digest,
    }
    if event.timings is not None:
        arguments["queue_ms"] = round(event.timings.queued_s * 1e3, 3)
        arguments["lease_ms"] = round(event.timings.lease_s * 1e3, 3)
        arguments["execute_ms"] = round(event.timings.execute_s * 1e3, 3)
    return arguments | ({"code": event.code, "message": event.message} if event.code else {})


def _fleet(fleet: Iterable[RunEvent], processes: Mapping[str, int], clock: _Clock) -> Iterator[TraceEvent]:
    """Yield scene loads and worker changes since the run was opened."""
    for event in fleet:
        process = processes.get(event.worker_id)
        if process is None or clock.us(event.at_s - event.held_s) < 0:
            continue
        at = {"pid": process, "tid": 0}
        if event.kind is EventKind.SCENE_WARM:
            scene = {"name": f"load {event.bundle_digest[7:15]}", "cat": "scene", "id": event.sequence, **at}
            yield {"ph": "b", "ts": clock.us(event.at_s - event.held_s), **scene}
            yield {"ph": "e", "ts": clock.us(event.at_s), **scene}
        else:
            arguments = {"message": event.message, "scene": event.bundle_digest}
            yield {
                "ph": "i",
                "s": "p",
                "name": event.kind.value,
                "ts": clock.us(event.at_s),
                "args": arguments,
                **at,
            }
