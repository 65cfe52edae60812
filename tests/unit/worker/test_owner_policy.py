"""Owner policy: pauses follow the preferences and do not toggle."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from embomatrix.worker.host.owner_policy import (
    CALM_SHARE,
    DAY_MINUTES,
    LOADED_S,
    WORKING,
    Hours,
    Observation,
    Preferences,
    next_pause_state,
)

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


def standings(history, preferences=WISHES):
    """Return (time, observation, pause state) after each step of a history of pauses between observations."""
    now_s, standing = 100.0, WORKING
    for passed_s, seen in history:
        now_s += passed_s
        standing = next_pause_state(standing, seen, preferences, now_s)
        yield now_s, seen, standing


def after(*history):
    return list(standings(history))[-1][2].reason


@given(HISTORIES)
def test_worker_pauses_outside_its_hours_on_battery_and_for_its_owner(history):
    for _, seen, standing in standings(history):
        objects = (
            8 * 60 <= seen.minute < 18 * 60
            or seen.on_mains is False
            or (seen.owner_idle_s is not None and seen.owner_idle_s < 300)
        )
        assert standing.reason or not objects


@given(HISTORIES)
def test_pause_lasts_until_the_calm_period_has_passed(history):
    for (_, _, before), (now_s, _, standing) in itertools.pairwise(standings(history)):
        if before.reason and not standing.reason:
            assert before.calm_since_s is not None
            assert now_s - before.calm_since_s >= WISHES.calm_s
            assert now_s - before.since_s >= WISHES.calm_s


@given(HISTORIES)
def test_worker_resumes_without_a_reason_to_pause(history):
    assert after(*history, (1.0, QUIET), (WISHES.calm_s + 1, QUIET)) == ""


@given(HISTORIES)
def test_worker_without_preferences_never_pauses(history):
    assert not any(standing.reason for _, _, standing in standings(history, Preferences()))


@given(
    st.lists(st.tuples(st.floats(0.1, 20), st.floats(0.5 * CALM_SHARE + 1e-6, 0.5)), max_size=40),
    st.booleans(),
)
def test_load_near_the_limit_does_not_toggle_a_pause(loads, paused):
    history = [(1.0, Observation(1200, 1000, True, 0.9))] * 12 if paused else [(1.0, QUIET)]
    history += [(passed_s, Observation(1200, 1000, True, load)) for passed_s, load in loads]
    assert bool(after(*history)) == paused


def test_only_lasting_load_pauses_a_worker():
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
def test_unknown_values_are_no_reason_to_pause(seen, reason):
    assert after((1.0, seen)) == reason


@given(MINUTES, MINUTES, MINUTES)
def test_hours_and_their_complement_cover_every_minute_once(begin, end, minute):
    if begin != end:
        assert Hours(begin, end).has(minute) != Hours(end, begin).has(minute)


@pytest.mark.parametrize(
    "text", ["18-8", "24:00-08:00", "18:00-18:00", "18:60-08:00", "nights", "18:00-08:00 "]
)
def test_invalid_hours_are_refused(text):
    with pytest.raises(ValidationError, match=r"HH:MM|all day"):
        Preferences(hours=text)


def test_hours_may_span_midnight():
    night = Hours.parse("18:00-8:00")
    assert [night.has(hour * 60) for hour in (0, 7, 8, 17, 18, 23)] == [True, True, False, False, True, True]
