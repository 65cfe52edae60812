"""Terminal display of a run: the remaining time of a phase."""

import pytest

from embomatrix.trainer.logging import display
from embomatrix.trainer.logging.display import RemainingTime


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: now[0])
    return now


def test_remaining_time_follows_from_the_share_so_far(clock):
    remaining = RemainingTime()
    assert remaining.guess_s("GRPO", 0.0) is None
    clock[0] += 1
    assert remaining.guess_s("GRPO", 0.01) is None, "too early to guess"
    clock[0] += 29
    assert remaining.guess_s("GRPO", 0.25) == pytest.approx(90.0)
    assert remaining.guess_s("GRPO", 1.0) == 0.0


def test_resumed_and_new_phases_count_from_their_own_beginning(clock):
    remaining = RemainingTime()
    remaining.guess_s("imitation", 0.5)
    clock[0] += 10
    assert remaining.guess_s("imitation", 0.75) == pytest.approx(10.0)
    assert remaining.guess_s("GRPO", 0.0) is None
    clock[0] += 10
    assert remaining.guess_s("GRPO", 0.0) is None, "no progress, no guess"
