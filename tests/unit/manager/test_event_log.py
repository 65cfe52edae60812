"""Run history log: bounds, completeness, and dropped events."""

from dataclasses import replace

from tests.fakes.worker import completed

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import GiveLease
from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutKey, RolloutRecord
from embomatrix.manager.observe.event_log import EVENTS_KEPT, LEAST_KEPT, RunEventLog
from embomatrix.manager.observe.run_archive import ArchivedRun, RunArchive, RunHistory
from embomatrix.manager.observe.training_reports import TrainingBook
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef, LeaseResult
from embomatrix.rpc.wire.run_log import EventKind, PhaseSummary, RunSeries, RunSummary
from embomatrix.rpc.wire.values import (
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Rollout,
    RunInfo,
    RunStats,
    Timings,
)

EPOCH_S = 1_000.0


def log_of(*run_ids):
    log = RunEventLog(epoch_s=EPOCH_S)
    for run_id in run_ids:
        log.open_run(run_id, "a run", now_s=1.0, cpu_s=0.0)
    return log


def lease(number, run_id="r1"):
    rollout = Rollout(f"x{number}", "g", "sha256:scene", "t", (), 0)
    return GiveLease(
        "w1", LeaseRef(f"l{number}", number), rollout, 1.0, LeaseOrigin(run_id, "b", f"x{number}", 1)
    )


def test_busy_run_drops_its_own_oldest_events_and_counts_them():
    log = log_of("busy", "quiet")
    for number in range(EVENTS_KEPT):
        log.leased(lease(number, "busy"), now_s=2.0)
    log.leased(lease(1, "quiet"), now_s=3.0)
    assert log.page("busy", 0).dropped == EVENTS_KEPT + 1 - EVENTS_KEPT // 2
    assert [event.kind for event in log.page("quiet", 0).events] == [EventKind.RUN_OPENED, EventKind.LEASED]
    assert log.page("quiet", 0).dropped == 0


def test_every_run_keeps_a_minimum_of_events():
    log = log_of(*(f"r{number}" for number in range(2 * EVENTS_KEPT // LEAST_KEPT)))
    for number in range(2 * LEAST_KEPT):
        log.leased(lease(number), now_s=2.0)
    assert len(log.page("r1", 0).events) == LEAST_KEPT


def test_pages_of_a_log_come_one_after_the_other():
    log = log_of("r1")
    for number in range(10):
        log.leased(lease(number), now_s=2.0)
    first = log.page("r1", 0, 4).events
    second = log.page("r1", first[-1].sequence, 100).events
    assert [event.rollout_id for event in (*first, *second)][1:] == [f"x{number}" for number in range(10)]
    assert first[0].at_s == EPOCH_S + 1.0
    assert log.page("another", 0) is None


def test_leases_of_closed_runs_are_not_logged():
    log = log_of("r1")
    log.close_run("r1", now_s=2.0)
    log.leased(lease(1), now_s=3.0)
    assert log.page("r1", 0) is None


def live(command):
    record = RolloutRecord(
        RolloutKey("r1", "b", command.rollout.rollout_id), command.rollout, 1, submitted_s=1.0, warm=True
    )
    return {command.ref.lease_id: LeaseRecord(command.ref, "w1", record, 2.0, 30.0, 60.0)}


def test_hedge_is_won_by_its_own_result():
    log = log_of("r1")
    first, second = lease(1), replace(lease(2), hedge=True)
    for command in (first, second):
        log.leased(command, now_s=2.0)
    crashed = InfraFailure(InfraCode.SLOT_CRASHED, "died")
    log.reported("w1", [LeaseResult(first.ref, crashed)], live(first), now_s=3.0)
    assert log.hedges_won == 0
    log.reported("w1", [LeaseResult(second.ref, completed())], live(second), now_s=3.0)
    assert log.hedges_won == 1


def test_results_of_dead_leases_are_not_logged():
    log = log_of("r1")
    log.reported("w1", [LeaseResult(LeaseRef("l1", 1), completed())], {}, now_s=3.0)
    log.reported("w2", [LeaseResult(lease(1).ref, completed())], live(lease(1)), now_s=3.0)
    assert [event.kind for event in log.page("r1", 0).events] == [EventKind.RUN_OPENED]


def test_phases_of_a_lease_add_up_to_its_life():
    log = log_of("r1")
    done = replace(completed(), timings=Timings(load_s=0.5, execute_s=1.0))
    log.reported("w1", [LeaseResult(lease(1).ref, done, slot=3, held_s=1.2)], live(lease(1)), now_s=4.0)
    (event,) = [event for event in log.page("r1", 0).events if event.kind is EventKind.COMPLETED]
    assert event.timings == Timings(queued_s=1.0, load_s=0.5, execute_s=1.0, lease_s=0.5)
    assert (event.slot, event.held_s, event.attempt) == (3, 1.2, 1)


def test_scene_events_are_logged_on_change_only():
    log = log_of()
    loading = Resident("a", ResidentState.LOADING)
    warm = Resident("a", ResidentState.WARM, load_s=0.5)
    broken = Resident("b", ResidentState.FAILED, error="no mesh")
    for now_s, residents in enumerate([[loading], [warm], [warm, broken], [warm, broken], [broken], []]):
        log.residents("w1", residents, now_s=now_s)
    found = [(event.at_s - EPOCH_S, event.kind, event.bundle_digest) for event in log.page("", 0).events]
    assert found == [
        (1, EventKind.SCENE_WARM, "a"),
        (2, EventKind.SCENE_FAILED, "b"),
        (4, EventKind.SCENE_EVICTED, "a"),
    ]
    assert log.scene_load.sum_s == 0.5


def summary(run_id):
    nothing = PhaseSummary()
    run = RunInfo(run_id, "a run", RunStats(), 0, 1.0, 2.0)
    return RunSummary(run, {}, (), RunSeries(1.0, (), ()), (), 0.0, nothing, nothing, 0, "1")


def test_archive_keeps_the_latest_runs_and_skips_damaged_files(tmp_path):
    archive = RunArchive(tmp_path / "runs", kept=3)
    for number in range(5):
        archive.keep(ArchivedRun(summary(f"r{number}"), log_of("r").page("r", 0).events))
    assert [run.run_id for run in archive.infos()] == ["r4", "r3", "r2"]
    (tmp_path / "runs" / "r3.run.gz").write_bytes(b"no gzip")
    assert [run.run_id for run in archive.infos()] == ["r4", "r2"]
    assert archive.load("r3") is None
    assert archive.load("r0") is None
    assert archive.load("../runs/r4") is None
    assert archive.load("r4\0") is None
    assert [event.kind for event in archive.load("r4").events] == [EventKind.RUN_OPENED]


def test_archive_is_listed_by_several_viewers_and_each_file_read_once(tmp_path, monkeypatch):
    archive = RunArchive(tmp_path / "runs")
    for number in range(3):
        archive.keep(ArchivedRun(summary(f"r{number}"), ()))
    first = archive.infos()
    read, files = [], archive._files
    monkeypatch.setattr(archive, "_message", read.append)

    def interrupted():
        monkeypatch.setattr(archive, "_files", files)
        assert archive.infos() == first, "another thread lists the files meanwhile"
        return files()

    monkeypatch.setattr(archive, "_files", interrupted)
    assert archive.infos() == first
    assert read == []


async def test_closed_run_is_timed_by_one_clock(tmp_path):
    log, training = RunEventLog(epoch_s=EPOCH_S), TrainingBook()
    history = RunHistory(log, RunArchive(tmp_path), ClusterState(lease_key=b"key"), training)
    history.opened("r1", "a run", PAPER)
    await history.closed("r1", RunStats(), PhaseSummary())
    (run,) = await history.kept()
    assert 0 <= run.closed_s - run.opened_s < 60, "the system's time may be set while a run is open"
