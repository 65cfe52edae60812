"""Everything is collected when nothing is in flight, once, and rarely while something is."""

from embomatrix.manager.runtime.garbage import LONGEST_S, Collector


def test_everything_is_collected_once_after_work():
    collector = Collector(0.0)
    assert not collector.note(0, 5.0)
    assert not collector.note(4096, 10.0)
    assert collector.note(0, 15.0)
    assert not collector.note(0, 20.0)


def test_a_manager_that_is_never_quiet_collects_in_the_end():
    collector = Collector(0.0)
    times = [now_s for now_s in range(0, 3 * int(LONGEST_S), 5) if collector.note(1, float(now_s))]
    assert times == [600, 1200]
