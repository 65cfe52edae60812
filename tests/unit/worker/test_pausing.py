"""When a worker pauses: never against a wish, never to and fro."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from embomatrix.worker.host.pausing import CALM_SHARE, LOADED_S, WORKING, Observation, judge
from embomatrix.worker.host.preferences import DAY_MINUTES, Hours, Preferences

WISHES = Preferences(hours="18:00-08:00", idle_s=300, mains_only=True, max_load=0.5, calm_s=30)
QUIET = Observation(minute=20 * 60, owner_idle_s=1000, on_mains=True, others_load=0.0)

MINUTES = st.integers(0, DAY_MINUTES - 1)
OBSERVATIONS = st.builds(
    Observation,
    MINUTES,
    st.none() | st.floats(0, 1000),
    st.none() | st.booleans(),
    st.none() | st.floats(0, 1),
)
HISTORIES = st.lists(st.tuples(st.floats(0.1, 20), OBSERVATIONS), max_size=40)


def standings(history, wishes=WISHES):
    """(time, observation, standing) after each step of a history of pauses between observations."""
    now_s, standing = 100.0, WORKING
    for passed_s, seen in history:
        now_s += passed_s
        standing = judge(standing, seen, wishes, now_s)
        yield now_s, seen, standing


def after(*history):
    return list(standings(history))[-1][2].reason


@given(HISTORIES)
def test_nothing_works_outside_of_its_hours_on_battery_or_while_the_owner_is_active(history):
    for _, seen, standing in standings(history):
        objects = (
            8 * 60 <= seen.minute < 18 * 60
            or seen.on_mains is False
            or (seen.owner_idle_s is not None and seen.owner_idle_s < 300)
        )
        assert standing.reason or not objects


@given(HISTORIES)
def test_a_pause_lasts_until_it_has_been_calm_for_long_enough(history):
    for (_, _, before), (now_s, _, standing) in itertools.pairwise(standings(history)):
        if before.reason and not standing.reason:
            assert before.calm_since_s is not None
            assert now_s - before.calm_since_s >= WISHES.calm_s
            assert now_s - before.since_s >= WISHES.calm_s


@given(HISTORIES)
def test_a_worker_works_again_once_nothing_speaks_against_it(history):
    assert after(*history, (1.0, QUIET), (WISHES.calm_s + 1, QUIET)) == ""


@given(HISTORIES)
def test_whoever_wishes_nothing_never_pauses(history):
    assert not any(standing.reason for _, _, standing in standings(history, Preferences()))


@given(
    st.lists(st.tuples(st.floats(0.1, 20), st.floats(0.5 * CALM_SHARE + 1e-6, 0.5)), max_size=40),
    st.booleans(),
)
def test_a_load_about_the_limit_changes_nothing(loads, paused):
    history = [(1.0, Observation(1200, 1000, True, 0.9))] * 12 if paused else [(1.0, QUIET)]
    history += [(passed_s, Observation(1200, 1000, True, load)) for passed_s, load in loads]
    assert bool(after(*history)) == paused


def test_others_must_stay_busy_before_it_counts():
    busy = Observation(1200, 1000, True, 0.9)
    assert after((1.0, busy), (LOADED_S - 1, busy)) == ""
    assert after((1.0, busy), (LOADED_S - 1, QUIET), (2.0, busy), (LOADED_S - 1, busy)) == ""
    assert after((1.0, busy), (LOADED_S, busy)) == "other programs use more than 50% of the cores"


@pytest.mark.parametrize(
    ("seen", "reason"),
    [
        (Observation(12 * 60), "outside of its hours 18:00-08:00"),
        (Observation(1200, on_mains=False), "on battery"),
        (Observation(1200, owner_idle_s=5), "its owner is active"),
        (Observation(1200), ""),
    ],
)
def test_the_reason_is_said_and_what_cannot_be_seen_is_no_reason(seen, reason):
    assert after((1.0, seen)) == reason


@given(MINUTES, MINUTES, MINUTES)
def test_hours_and_the_rest_of_the_day_share_every_minute_between_them(begin, end, minute):
    if begin != end:
        assert Hours(begin, end).has(minute) != Hours(end, begin).has(minute)


@pytest.mark.parametrize(
    "text", ["18-8", "24:00-08:00", "18:00-18:00", "18:60-08:00", "nights", "18:00-08:00 "]
)
def test_hours_that_are_none_are_refused(text):
    with pytest.raises(ValidationError, match=r"HH:MM|all day"):
        Preferences(hours=text)


def test_hours_reach_over_midnight():
    night = Hours.parse("18:00-8:00")
    assert [night.has(hour * 60) for hour in (0, 7, 8, 17, 18, 23)] == [True, True, False, False, True, True]
