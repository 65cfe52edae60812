"""Slot spans and the Chrome trace made of them: worker durations on the manager's clock."""

import itertools
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.cli.cluster.trace import chrome_trace
from embomatrix.rpc.timeline import SlotKey, busy_share, slot_spans
from embomatrix.rpc.wire.run_log import EventKind, RunEvent
from embomatrix.rpc.wire.values import Timings

ROUNDING_US = 0.002


def completed(sequence, at_s, execute_s, slot=1, worker="w1", load_s=0.0, batch="b"):
    return RunEvent(
        sequence, at_s, EventKind.COMPLETED, "r", batch, f"x{sequence}", worker, "sha256:scene", slot, 1,
        timings=Timings(load_s=load_s, execute_s=execute_s), held_s=execute_s,
    )  # fmt: skip


def submitted(sequence, at_s, size, batch="b"):
    return RunEvent(sequence, at_s, EventKind.SUBMITTED, "r", batch, size=size)


@st.composite
def histories(draw):
    """Draw true slot histories and the manager's view of them, with late and batched results."""
    truth, seen = [], []
    for slot in range(1, draw(st.integers(1, 3)) + 1):
        now_s = 100.0
        for _ in range(draw(st.integers(1, 12))):
            load_s = draw(st.sampled_from([0.0, 0.0, 0.5]))
            begin_s = now_s + load_s + draw(st.floats(0.0, 0.3))
            now_s = begin_s + draw(st.floats(1e-4, 0.2))
            truth.append((slot, begin_s, now_s, load_s))
    delay_s = draw(st.sampled_from([0.0, 0.01, 0.25]))
    for number, (slot, begin_s, end_s, load_s) in enumerate(sorted(truth, key=lambda span: span[2]), start=2):
        arrived_s = (end_s // delay_s + 1) * delay_s if delay_s else end_s
        seen.append(completed(number, arrived_s, end_s - begin_s, slot, load_s=load_s))
    return truth, [submitted(1, 100.0, len(seen)), *seen]


@given(histories())
def test_spans_of_a_slot_never_overlap_and_never_start_early(history):
    truth, events = history
    for key, spans in slot_spans(events).items():
        was = sorted((begin_s, end_s) for slot, begin_s, end_s, _ in truth if slot == key.slot)
        for span, (begin_s, end_s) in zip(spans, was, strict=True):
            assert span.begin_s >= begin_s - 1e-9
            assert span.end_s - span.begin_s == pytest.approx(end_s - begin_s, abs=1e-6)
        assert all(one.end_s <= two.begin_s + 1e-9 for one, two in itertools.pairwise(spans))


@given(histories())
def test_track_has_no_overlap_and_each_rollout_once(history):
    _, events = history
    trace = chrome_trace(events, (), "a run")["traceEvents"]
    tracks = {}
    for event in trace:
        if event["ph"] == "X" and event["pid"] != 1:
            tracks.setdefault((event["pid"], event["tid"]), []).append(event)
    for track in tracks.values():
        assert all(
            one["ts"] + one["dur"] <= two["ts"] + ROUNDING_US for one, two in itertools.pairwise(track)
        )
    executed = [event["args"]["rollout"] for event in trace if event.get("name") == "execute"]
    assert Counter(executed) == Counter(event.rollout_id for event in events[1:])
    assert all(event["ts"] >= 0 for event in trace if "ts" in event)


def test_gaps_are_split_into_idle_and_load_time():
    events = [submitted(1, 10.0, 2), completed(2, 11.0, 1.0), completed(3, 15.0, 1.0, load_s=2.0)]
    trace = chrome_trace(events, (), "a run")["traceEvents"]
    parts = [(event["name"], event["ts"], event["dur"]) for event in trace if event["ph"] == "X"]
    assert parts == [
        ("submit 2", 0, 1000),
        ("execute", 0, 1e6),
        ("idle", 1e6, 1e6),
        ("load", 2e6, 2e6),
        ("execute", 4e6, 1e6),
    ]


def test_failed_lease_occupies_its_slot():
    failed = completed(2, 12.0, 0.0)._replace(
        kind=EventKind.FAILED, timings=None, held_s=2.0, code="slot_crashed", message="died"
    )
    trace = chrome_trace([submitted(1, 10.0, 1), failed], (), "a run")["traceEvents"]
    (part,) = [event for event in trace if event["name"] == "failed"]
    assert (part["ts"], part["dur"], part["args"]["message"]) == (0, 2e6, "died")


def test_rollout_with_a_dropped_submission_is_drawn():
    trace = chrome_trace([completed(2, 12.0, 1.0)], (), "a run")["traceEvents"]
    assert [event["name"] for event in trace if event["ph"] == "X"] == ["execute"]


def test_scene_loads_and_losses_are_shown_beside_the_slots():
    run = [submitted(1, 10.0, 1), completed(3, 12.0, 1.0)]
    warm = RunEvent(2, 11.0, EventKind.SCENE_WARM, worker_id="w1", bundle_digest="sha256:kitchen", held_s=0.5)
    lost = RunEvent(4, 13.0, EventKind.WORKER_LOST, worker_id="w1", message="it left")
    before = warm._replace(sequence=0, at_s=9.0)
    elsewhere = warm._replace(worker_id="w2")
    trace = chrome_trace(run, [before, warm, elsewhere, lost], "a run")["traceEvents"]
    assert [(event["ph"], event["ts"]) for event in trace if event["ph"] in "bei"] == [
        ("b", 0.5e6),
        ("e", 1e6),
        ("i", 3e6),
    ]


def test_share_of_busy_slots_is_weighted_by_time():
    spans = slot_spans([completed(1, 1.0, 1.0, slot=1), completed(2, 2.0, 0.5, slot=2)])
    assert set(spans) == {SlotKey("w1", 1), SlotKey("w1", 2)}
    assert busy_share(spans, 0.0, 1.0, 3) == [0.5, 0.25, 0.0]
