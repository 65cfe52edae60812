"""Health sentence, list pages, and slot timelines."""

from dataclasses import replace

from embomatrix.manager.observe.metrics import FAILURES_KEPT, FailureNote
from embomatrix.manager.web.cluster_view import Mood, Overview, Snapshot, WorkerView, health
from embomatrix.manager.web.rest_values import TRACKS, run_page, timeline, worker_page
from embomatrix.rpc.wire.run_log import EventKind, EventPage, RunEvent
from embomatrix.rpc.wire.values import RunInfo, RunStats, Timings

CALM = Overview(
    uptime_s=60.0,
    workers={"ready": 2},
    slots=4,
    slots_busy=1,
    queued=3,
    leased=1,
    runs=1,
    outcomes={"completed": 9},
    throughput=[1, 2],
    latency_p50_s=0.1,
    latency_p95_s=0.2,
    prewarm_hits=9,
    prewarm_misses=1,
    prewarm_wasted=0,
    prewarm_lead_s=1.0,
    redispatched=0,
    stale_results=0,
    failures=[],
)
NOTE = FailureNote(1000.0, "slot_crashed", "signal 11", "w1", "r1", "x1")


def mood(*, paused=False, now_s=1010.0, **changes):
    view = health(replace(CALM, **changes), paused=paused, now_s=now_s)
    return view.mood, view.sentence


def test_health_reports_the_most_important_fact():
    assert mood() == (Mood.GOOD, "All is well.")
    assert mood(runs=0, queued=0) == (Mood.IDLE, "Ready: 2 workers wait for a run.")
    assert mood(workers={}, queued=0) == (Mood.IDLE, "No worker has joined yet.")
    assert mood(workers={"left": 4}, queued=0) == (Mood.IDLE, "Every worker has left.")
    assert mood(workers={"left": 4}) == (Mood.BAD, "3 rollouts are queued and no worker is connected.")
    assert mood(workers={"ready": 1, "left": 9}) == (Mood.GOOD, "All is well.")
    assert mood(workers={"lost": 2, "paused": 1, "left": 1}) == (Mood.BAD, "None of 3 workers is working.")
    assert mood(workers={"left": 4}, queued=1)[1] == "1 rollout is queued and no worker is connected."
    assert mood(workers={"lost": 1})[1] == "The only worker is not working."
    assert mood(leased=0, queued=1)[1] == "1 rollout is queued and none runs: no scene is warm yet."
    assert mood(workers={"ready": 1, "quarantined": 1})[0] is Mood.BAD
    assert mood(workers={"ready": 1, "lost": 1})[1].startswith("1 worker lost recently")
    assert mood(workers={"ready": 1, "lost": 2})[1].endswith("all leases were re-dispatched.")
    assert mood(unplaceable=1, workers={"ready": 1, "lost": 1}) == (
        Mood.WARNING,
        "1 announced scene fits on no worker: the look-ahead page shows the reason.",
    )
    assert mood(workers={"ready": 7, "lost": 3}, failures=[NOTE]) == (
        Mood.BAD,
        "3 of 10 workers were lost recently; their leases were re-dispatched.",
    )
    assert "slot_crashed" in mood(workers={"ready": 12, "lost": 3}, failures=[NOTE])[1]
    assert mood(overhead=0.4, core_share=0.3) == (Mood.GOOD, "All is well."), "its core has room"
    assert mood(core_share=0.9) == (
        Mood.WARNING,
        "The manager uses 90% of its core: send larger batches, or give it a faster core.",
    )
    assert mood(leased=0)[1] == "3 rollouts are queued and none runs: no scene is warm yet."
    full = "the state file can't be written: make room on its disk"
    assert mood(store=full, paused=True) == (
        Mood.BAD,
        f"The state store cannot be written, so dispatch has stopped: {full}.",
    )
    assert mood(paused=True, workers={})[1].startswith("Dispatch is paused")


def test_failures_are_reported_for_five_minutes():
    assert mood(failures=[NOTE])[1] == "1 rollout failed in the last 5 minutes, with slot_crashed."
    equal = replace(NOTE, count=4)
    assert mood(failures=[equal, NOTE])[1].startswith(
        "5 rollouts failed in the last 5 minutes, the latest with"
    )
    assert mood(failures=[NOTE] * FAILURES_KEPT)[1].startswith(f"{FAILURES_KEPT} or more rollouts")
    assert mood(failures=[NOTE], now_s=2000.0) == (Mood.GOOD, "All is well.")


def worker(name, state):
    return WorkerView(name, state, "", 2, 0, 0, 0, 4, 1024, 0, 0.0, "", {}, 0.5, [], [])


SEEN = Snapshot(
    1000.0,
    health(CALM, paused=False, now_s=1000.0),
    False,
    CALM,
    [
        *(worker(f"w{number:04}", "ready") for number in range(1000)),
        worker("Zoe", "lost"),
        worker("ann", "paused"),
    ],
    [RunInfo(f"r{number}", "", RunStats(), 0) for number in range(5)],
    [],
    training=[],
)


def test_pages_hold_every_worker_once_with_trouble_first():
    found = []
    while len(page := worker_page(SEEN, offset=len(found), limit=300).items):
        found += [row.worker_id for row in page]
    assert found[:2] == ["Zoe", "ann"]
    assert sorted(found) == sorted(row.worker_id for row in SEEN.workers)
    assert [row.run_id for row in run_page(SEEN, offset=1, limit=2).items] == ["r3", "r2"]


def test_page_holds_matching_workers_only():
    assert [row.worker_id for row in worker_page(SEEN, state="lost").items] == ["Zoe"]
    assert worker_page(SEEN, search="W000", limit=3).total == 10
    attic = replace(SEEN.workers[0], worker_id="by-label", labels={"room": "Attic"})
    labelled = replace(SEEN, workers=[*SEEN.workers, attic])
    assert [row.worker_id for row in worker_page(labelled, search="room=attic").items] == ["by-label"]
    beyond = worker_page(SEEN, offset=5000)
    assert (beyond.total, beyond.items) == (1002, [])


def test_timeline_shows_the_last_seconds_of_each_slot():
    def done(sequence, at_s, kind=EventKind.COMPLETED, code=""):
        timings = Timings(execute_s=0.5, load_s=0.25, deliver_s=0.125)
        rollout = f"x{sequence}"
        return RunEvent(
            sequence, at_s, kind, "r1", "b", rollout, "w1", "sha256:aa", 1, 2, code, timings=timings
        )

    page = EventPage((done(1, 90.0), done(2, 99.0), done(3, 100.0, EventKind.FAILED, "slot_oom")), 7)
    view = timeline("r1", page, seconds=5.0)
    assert (view.from_s, view.until_s, view.dropped) == (95.0, 100.0, 7)
    (track,) = view.tracks
    assert [(span.rollout_id, span.outcome) for span in track.spans] == [
        ("x2", "completed"),
        ("x3", "slot_oom"),
    ]
    first = track.spans[0]
    assert (first.begin_s, first.end_s, first.load_s, first.deliver_s) == (98.5, 99.0, 0.25, 0.125)
    assert timeline("r1", EventPage((), 0), seconds=5.0).tracks == []


def test_timeline_counts_busy_slots_and_filters_by_worker():
    def done(number):
        timings = Timings(execute_s=0.5)
        worker = f"desk-{number:03}"
        return RunEvent(
            number, 100.0, EventKind.COMPLETED, "r1", "b", f"x{number}", worker, "", 1, timings=timings
        )

    page = EventPage(tuple(map(done, range(TRACKS + 30))), 0)
    view = timeline("r1", page, seconds=5.0)
    assert (view.slots, len(view.tracks)) == (TRACKS + 30, TRACKS)
    of_one = timeline("r1", page, seconds=5.0, search="Desk-21")
    assert [track.worker_id for track in of_one.tracks] == [f"desk-21{digit}" for digit in range(10)]
