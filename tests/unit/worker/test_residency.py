"""Residency decisions from wanted scenes, memory and last use."""

from hypothesis import given
from hypothesis import strategies as st

from embomatrix.worker.slots.residency import NOTHING, UNKNOWN_MB, Decision, HeldScene, decide, surplus

DIGESTS = st.sampled_from([f"d{number}" for number in range(8)])
HELD = st.dictionaries(
    DIGESTS, st.builds(HeldScene, st.floats(1, 200), st.integers(0, 100), st.booleans()), max_size=8
)
WANTED = st.lists(DIGESTS, unique=True, max_size=8)


def _held(*digests, memory_mb=50.0, busy=()):
    return {
        digest: HeldScene(memory_mb, last_used=number, busy=digest in busy)
        for number, digest in enumerate(digests)
    }


def test_most_urgent_missing_scene_is_next():
    assert decide(["a", "b"], _held("a"), budget_mb=500, known_mb={}) == Decision("b")


def test_nothing_is_loaded_if_all_wanted_scenes_are_held():
    assert decide(["a"], _held("a", "z"), budget_mb=500, known_mb={}) == NOTHING


def test_failed_scene_does_not_block_the_next():
    assert decide(["bad", "b"], {}, budget_mb=500, known_mb={}, refused={"bad"}) == Decision("b")


def test_unwanted_scenes_are_evicted_first_by_last_use():
    decision = decide(["a", "new"], _held("x", "y", "a"), budget_mb=170, known_mb={"new": 50})
    assert decision == Decision("new", ("x",))


def test_less_urgent_scene_is_evicted_for_a_more_urgent_one_only():
    held = _held("late")
    assert decide(["now", "late"], held, budget_mb=60, known_mb={"now": 50}) == Decision("now", ("late",))
    assert decide(["late", "now"], held, budget_mb=60, known_mb={"now": 50}) == NOTHING


def test_busy_scene_is_never_evicted():
    assert decide(["new"], _held("x", busy={"x"}), budget_mb=60, known_mb={"new": 50}) == NOTHING


def test_scene_larger_than_the_budget_is_loaded_alone():
    assert decide(["huge"], _held("x"), budget_mb=60, known_mb={"huge": 900}) == Decision("huge", ("x",))


def test_scenes_beyond_the_budget_are_evicted_down_to_the_most_urgent():
    assert surplus(["a", "b"], _held("a", "b", "z", memory_mb=100), budget_mb=150) == ("z", "b")
    assert surplus(["a"], _held("a", memory_mb=1000), budget_mb=150) == ()


@given(WANTED, HELD, st.floats(50, 800))
def test_load_stays_within_the_budget_or_is_the_only_scene(wanted, held, budget_mb):
    decision = decide(wanted, held, budget_mb=budget_mb, known_mb={})
    left = {digest: scene for digest, scene in held.items() if digest not in decision.evict}
    assert not any(held[digest].busy for digest in decision.evict)
    if decision.load:
        assert decision.load in wanted
        assert decision.load not in held
        assert not left or sum(scene.memory_mb for scene in left.values()) + UNKNOWN_MB <= budget_mb + 1e-6
    else:
        assert decision.evict == ()
