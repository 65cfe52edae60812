"""Worker sessions: superseded, suspected, lost, and recovered."""

import pytest

from embomatrix.manager.control.events import (
    DrainChanged,
    SuspicionChanged,
    WorkerJoined,
    WorkerLost,
)
from embomatrix.manager.runtime.registry import LivenessLimits, Registry, WorkerStanding
from embomatrix.rpc.status import NotFoundError, SessionLostError, SupersededError, UnknownSessionError
from embomatrix.rpc.wire.values import Resources

RESOURCES = Resources(2, 2, 1024)
LIMITS = LivenessLimits(heartbeat_s=1.0, lost_after_s=10.0, stream_grace_s=1.0, remember_lost_s=60.0)


@pytest.fixture
def registry():
    return Registry(LIMITS)


def join(registry, worker_id="w1", boot_id="boot-1", now_s=0.0):
    return registry.register(worker_id, boot_id, RESOURCES, now_s=now_s)


def test_registered_worker_is_found_by_its_session(registry):
    session, events = join(registry)
    assert events == [WorkerJoined("w1", RESOURCES)]
    assert registry.find(session.session_id, session.epoch) is session


def test_another_process_of_the_same_worker_ends_the_first(registry):
    old, _ = join(registry)
    new, events = join(registry, boot_id="boot-2")
    assert [type(event) for event in events] == [WorkerLost, WorkerJoined]
    assert new.epoch > old.epoch
    with pytest.raises(SupersededError, match="register again"):
        registry.find(old.session_id, old.epoch)


def test_same_process_keeps_its_leases_under_a_new_session(registry):
    old, _ = join(registry)
    new, events = join(registry)
    assert events == []
    with pytest.raises(SupersededError):
        registry.find(old.session_id, old.epoch)
    assert registry.find(new.session_id, new.epoch) is new


def test_lost_worker_is_told_that_it_was_lost_and_not_replaced(registry):
    session, _ = join(registry)
    registry.end(session, "its connection broke")
    with pytest.raises(SessionLostError, match="its connection broke"):
        registry.find(session.session_id, session.epoch)
    with pytest.raises(SessionLostError, match="its connection broke"):
        registry.find_by_id(session.session_id)


def test_superseded_session_is_never_one_of_a_former_manager(registry):
    old, _ = join(registry)
    join(registry, boot_id="boot-2")
    with pytest.raises(SupersededError, match="was superseded") as error:
        registry.find_by_id(old.session_id)
    assert not isinstance(error.value, UnknownSessionError)


def test_session_with_a_wrong_epoch_is_refused(registry):
    session, _ = join(registry)
    with pytest.raises(SupersededError):
        registry.find(session.session_id, session.epoch + 1)


def test_three_missed_heartbeats_make_a_suspect_until_the_next_message(registry):
    session, _ = join(registry)
    assert registry.tick(now_s=2.9) == []
    assert registry.tick(now_s=3.0) == [SuspicionChanged("w1", suspect=True)]
    assert registry.tick(now_s=3.1) == []
    assert registry.heard(session, now_s=4.0) == [SuspicionChanged("w1", suspect=False)]


def test_worker_is_lost_after_ten_silent_seconds(registry):
    session, _ = join(registry)
    registry.tick(now_s=5.0)
    (lost,) = registry.tick(now_s=10.0)
    assert isinstance(lost, WorkerLost)
    with pytest.raises(SupersededError, match="is lost"):
        registry.find(session.session_id, session.epoch)


def test_broken_stream_loses_a_worker_after_a_second(registry):
    session, _ = join(registry)
    registry.attach(session, now_s=0.0)
    registry.detach(session, now_s=1.0)
    assert registry.tick(now_s=1.9) == []
    assert [type(event) for event in registry.tick(now_s=2.0)] == [WorkerLost]


def test_stream_restored_within_the_grace_costs_nothing(registry):
    session, _ = join(registry)
    registry.attach(session, now_s=0.0)
    registry.detach(session, now_s=1.0)
    registry.attach(session, now_s=1.5)
    assert registry.tick(now_s=2.5) == []


def test_silence_during_a_manager_stall_is_excused(registry):
    session, _ = join(registry)
    registry.attach(session, now_s=0.0)
    left, _ = join(registry, "w2")
    registry.attach(left, now_s=0.0)
    registry.detach(left, now_s=1.0)
    registry.heard(session, now_s=1.5)
    registry.excuse_silence(30.0, now_s=31.6)
    assert registry.tick(now_s=31.6) == []
    assert [event.worker_id for event in registry.tick(now_s=32.0)] == ["w2"]
    assert registry.tick(now_s=34.6) == [SuspicionChanged("w1", suspect=True)]
    registry.excuse_silence(30.0, now_s=35.0)
    assert session.last_seen_s == 35.0, "no worker was heard in the future"


def test_heartbeats_slow_down_in_a_large_cluster(registry):
    assert registry.interval_s == 1.0
    for index in range(400):
        join(registry, f"w{index}")
    assert registry.interval_s == 4.0


def test_lost_worker_is_remembered_for_a_while(registry):
    join(registry)
    registry.tick(now_s=10.0)
    assert registry.sessions["w1"].standing is WorkerStanding.LOST
    registry.tick(now_s=61.0)
    assert not registry.sessions


def test_worker_that_leaves_in_order_is_not_counted_as_lost(registry):
    said, _ = join(registry, "said")
    drained, _ = join(registry, "drained")
    assert registry.end(said, "it left", WorkerStanding.LEFT) == [WorkerLost("said", "it left")]
    registry.attach(drained, now_s=0.0)
    registry.drain("drained")
    registry.detach(drained, now_s=0.1)
    assert registry.tick(now_s=2.9) == [WorkerLost("drained", "it drained and left")]
    assert {session.standing for session in registry.sessions.values()} == {WorkerStanding.LEFT}
    with pytest.raises(SupersededError, match="it left"):
        registry.find(said.session_id, said.epoch)
    with pytest.raises(NotFoundError, match=r"'said' is gone .it left.: restart it"):
        registry.resume("said")
    with pytest.raises(NotFoundError, match=r"no worker 'nobody' \(connected: none\)"):
        registry.resume("nobody")
    registry.tick(now_s=61.0)
    assert not registry.sessions


def test_lost_worker_may_register_again(registry):
    join(registry)
    registry.tick(now_s=10.0)
    _, events = join(registry, now_s=11.0)
    assert events == [WorkerJoined("w1", RESOURCES)]


def test_draining_an_unknown_worker_names_the_connected_ones(registry):
    join(registry)
    assert registry.drain("w1") == [DrainChanged("w1", drained=True)]
    with pytest.raises(NotFoundError, match="connected: w1"):
        registry.drain("w2")


def test_heartbeats_renew_leases_in_time_in_any_cluster_size(registry):
    for index in range(5000):
        join(registry, f"w{index}")
    assert registry.interval_s == LIMITS.longest_heartbeat_s == 7.5


def test_one_silent_worker_among_many_is_found(registry):
    sessions = [join(registry, f"w{index}")[0] for index in range(50)]
    for at_s in (2.0, 4.0):
        for session in sessions[1:]:
            registry.heard(session, now_s=at_s)
    assert registry.tick(now_s=4.0) == [SuspicionChanged("w0", suspect=True)]
