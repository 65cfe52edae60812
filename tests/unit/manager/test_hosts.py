"""Workers' machines and log lines in bounded memory."""

from embomatrix.manager.observe.hosts import LINES, POINTS, STEP_S, HostBook
from embomatrix.rpc.wire.values import HostUse


def beat(book, worker="w1", *, at_s=0.0, cpu=0.5, used=100, lines=(), boot="b1", session="s1"):
    book.note(worker, boot, session, HostUse(cpu, used, 1000), lines, at_s=at_s)


def test_heartbeats_of_one_step_are_averaged_and_old_steps_are_dropped():
    book = HostBook()
    for number, cpu in enumerate((0.2, 0.4, 0.6)):
        beat(book, at_s=number * STEP_S / 3, cpu=cpu, used=100 * (number + 1))
    first = book.curve_of("w1")
    assert (first.at_s, first.cpu_share, first.memory_used_mb, first.memory_mb) == ([0.0], [0.4], [200], 1000)
    for number in range(1, 2 * POINTS):
        beat(book, at_s=number * STEP_S)
    later = book.curve_of("w1")
    assert [len(later.at_s), len(later.cpu_share), len(later.memory_used_mb)] == [POINTS] * 3
    assert later.at_s[-1] == (2 * POINTS - 1) * STEP_S


def test_silence_leaves_a_gap_and_points_before_the_last_half_hour_are_dropped():
    book = HostBook()
    for at_s in (0.0, STEP_S, 20 * STEP_S):
        beat(book, at_s=at_s)
    later = book.curve_of("w1")
    assert later.at_s == [0.0, STEP_S, 2 * STEP_S, 20 * STEP_S]
    assert later.cpu_share == [0.5, 0.5, None, 0.5]
    assert later.memory_used_mb == [100, 100, None, 100]
    beat(book, at_s=(POINTS + 1) * STEP_S)
    assert book.curve_of("w1").at_s[0] == 2 * STEP_S, "two points are older than half an hour"
    beat(book, at_s=86_400.0)
    assert (book.curve_of("w1").at_s, book.curve_of("w1").cpu_share) == ([86_400.0], [0.5])


def test_clock_that_is_set_back_begins_a_new_step():
    book = HostBook()
    beat(book, at_s=1000.0)
    beat(book, at_s=10.0)
    assert book.curve_of("w1").at_s == [1000.0, 10.0]


def test_unknown_worker_and_one_that_reports_nothing_have_empty_curves():
    book = HostBook()
    book.note("old", "b", "s", None, (), at_s=0.0)
    for worker in ("old", "nobody"):
        assert book.use_of(worker) is None
        assert book.curve_of(worker).at_s == book.lines_of(worker) == []


def test_lines_are_repeated_in_a_new_session_and_stay_after_a_crash():
    book = HostBook()
    beat(book, lines=["one", "two"])
    beat(book, lines=["one", "two", "three"], session="s2")
    assert book.lines_of("w1") == ["one", "two", "three"]
    beat(book, lines=["started again"], session="s3", boot="b2")
    assert book.lines_of("w1") == ["one", "two", "three", "started again"]
    beat(book, lines=[f"line {number}" for number in range(2 * LINES)], session="s3", boot="b2")
    assert len(book.lines_of("w1")) == LINES


def test_secrets_and_control_characters_never_reach_the_page():
    book = HostBook()
    beat(book, lines=["authorization: Bearer abc.def", "redis://user:hidden@host", "red \x1b[31m"])
    assert book.lines_of("w1") == ["authorization: Bearer ***", "redis://user:***@host", "red \\u001b[31m"]


def test_memory_for_all_machines_is_bounded():
    book = HostBook(hosts=30, lines=100)
    for number in range(40):
        beat(book, f"w{number}", lines=["line"] * 10)
    assert book.use_of("w9") is None
    assert book.use_of("w10") is not None
    kept = [len(book.lines_of(f"w{number}")) for number in range(40)]
    assert 80 <= sum(kept) <= 100
    assert kept[-1] == 10, "the worker that was heard last keeps its lines"
