"""Outbox: results are kept until they are acknowledged, and sent again on the next stream."""

from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from embomatrix.host.backoff import Backoff
from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult
from embomatrix.rpc.wire.values import InfraCode, InfraFailure
from embomatrix.worker.link import outbox as module
from embomatrix.worker.link.outbox import ResultOutbox


def _result(number):
    return LeaseResult(LeaseRef(f"l{number}", 1), InfraFailure(InfraCode.SLOT_CRASHED, "died"))


def _filled(count):
    outbox = ResultOutbox()
    for number in range(count):
        outbox.put(_result(number))
    return outbox


def test_result_is_sent_once_per_stream_and_kept():
    outbox = _filled(3)
    assert outbox.take_unsent(2) == (_result(0), _result(1))
    assert outbox.take_unsent(2) == (_result(2),)
    assert not outbox.has_unsent
    assert len(outbox) == 3


def test_message_of_results_stays_below_the_manager_s_bound():
    outbox = ResultOutbox()
    most = module.MESSAGE_BYTES // 3
    for number in range(5):
        failure = InfraFailure(InfraCode.SLOT_CRASHED, "x" * most)
        outbox.put(LeaseResult(LeaseRef(f"l{number}", 1), failure))
    assert [len(outbox.take_unsent(256)) for _ in range(3)] == [2, 2, 1]
    outbox.begin_stream()
    assert outbox.unsent() == tuple(LeaseRef(f"l{number}", 1) for number in range(5))


def test_new_stream_sends_unacknowledged_results():
    outbox = _filled(3)
    outbox.take_unsent(3)
    outbox.acknowledge(_result(1).ref)
    outbox.begin_stream()
    assert outbox.take_unsent(10) == (_result(0), _result(2))


def test_acknowledgement_of_an_unknown_result_is_ignored():
    outbox = _filled(1)
    outbox.acknowledge(LeaseRef("other", 9))
    assert len(outbox) == 1


def test_oldest_result_is_dropped_beyond_the_limit():
    outbox = _filled(module.LIMIT + 1)
    assert len(outbox) == module.LIMIT
    assert outbox.take_unsent(1) == (_result(1),)


@given(st.lists(st.sampled_from(["put", "take", "ack", "stream"]), max_size=40))
def test_no_result_is_lost_before_it_is_acknowledged(actions):
    outbox, kept, count = ResultOutbox(), {}, 0
    for action in actions:
        match action:
            case "put":
                outbox.put(_result(count))
                kept[_result(count).ref] = _result(count)
                count += 1
            case "take":
                outbox.take_unsent(2)
            case "ack" if kept:
                ref = next(iter(kept))
                del kept[ref]
                outbox.acknowledge(ref)
            case "stream":
                outbox.begin_stream()
    outbox.begin_stream()
    assert outbox.take_unsent(1000) == tuple(kept.values())


def test_waits_double_up_to_the_longest_and_start_over_after_a_success():
    rng = default_rng(0)
    backoff = Backoff(0.2, 3.0, jitter=lambda: rng.uniform(0.8, 1.2))
    waits = [backoff.next_s() for _ in range(12)]
    assert all(0.8 <= wait / min(3.0, 0.2 * 2**n) <= 1.2 for n, wait in enumerate(waits))
    backoff.reset()
    assert backoff.next_s() <= 0.24
