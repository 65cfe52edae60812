"""Slicing, cleaning and soaking, their limits, and their reset."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.household import household_scene
from tests.fakes.plans import executed, plan_of, task_over

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PROFILES, Skill
from embomatrix.world.bundle import Bundle
from embomatrix.world.task import Profile


@pytest.fixture(scope="module")
def home():
    simulator = load_simulator(Bundle(household_scene(), {}))
    yield simulator
    simulator.close()


def succeeded(home, text):
    trace = executed(home, text)
    assert trace.failure is None, trace.steps[-1].message
    return trace


def failed(home, text):
    trace = executed(home, text)
    return trace.failure


KNIFE = "move table_knife_1; pick_up table_knife_1"
RAG = "move rag_1; pick_up rag_1"
TAP = "move sink_1; toggle_on sink_1"


def test_knife_in_the_hand_slices_bread(home):
    trace = succeeded(home, f"{KNIFE}; move loaf_1; slice_object_with_tool loaf_1 table_knife_1")
    assert home.facts.holds("sliced", ("loaf_1",))
    assert home.facts.holds("real", ("loaf_1",))
    assert home.facts.holds("ontop", ("loaf_1", "breakfast_table_1"))
    assert trace.steps[-1].message == "sliced loaf_1"
    assert trace.touched == {"table_knife_1", "loaf_1"}


MELON = f"{KNIFE}; move melon_1; slice_object_with_tool melon_1 table_knife_1"


def test_melon_halves_appear_in_its_place(home):
    before = home.world.engine.pose("melon_1").position_m
    succeeded(home, MELON)
    engine = home.world.engine
    for half in ("half_melon_1", "half_melon_2"):
        assert home.facts.holds("real", (half,))
        assert home.facts.holds("ontop", (half, "breakfast_table_1"))
        assert home.facts.holds("frozen", (half,)), "pieces are as cold as the whole was"
        assert not engine.penetrates(half)
        assert engine.settle(half).stable
        x, y, _ = engine.pose(half).position_m
        assert abs(x - before[0]) + abs(y - before[1]) < 0.2


def test_sliced_object_is_gone_and_its_halves_are_real(home):
    executed(home, "turn 1")
    assert home.facts.holds("future", ("half_melon_1",))
    assert not home.facts.holds("real", ("half_melon_1",))
    assert not home.facts.holds("inroom", ("half_melon_1", "kitchen_0"))
    succeeded(home, MELON)
    assert not home.facts.holds("future", ("half_melon_1",))
    assert not home.facts.holds("real", ("melon_1",))
    assert not home.facts.holds("future", ("melon_1",))
    assert not home.facts.holds("frozen", ("melon_1",))
    assert failed(home, f"{MELON}; move melon_1") is FailureReason.NOT_THERE


def test_half_can_be_picked_up_and_placed(home):
    succeeded(
        home,
        f"{MELON}; move coffee_table_1; place coffee_table_1 ontop; move half_melon_2; pick_up half_melon_2; "
        "move fridge_1; place fridge_1 ontop",
    )
    assert home.facts.holds("ontop", ("half_melon_2", "fridge_1"))


def test_absent_object_can_not_be_used(home):
    trace = executed(home, "pick_up half_melon_1")
    assert trace.failure is FailureReason.NOT_THERE
    assert trace.final == ()
    final = executed(home, MELON).final
    assert "melon_1: not there" in final


def test_dry_cloth_removes_dust_but_not_stains(home):
    wiped = succeeded(home, f"{RAG}; move plate_1; clean_object_with_tool plate_1 rag_1")
    assert wiped.steps[-1].message == "cleaned plate_1; plate_1 is now free of dust"
    assert not home.facts.holds("dusty", ("plate_1",))
    assert not home.facts.holds("covered", ("plate_1", "dust.n.01"))
    trace = executed(home, f"{RAG}; move plate_2; clean_object_with_tool plate_2 rag_1")
    assert trace.failure is FailureReason.NEEDS_SOAKING
    assert home.facts.holds("stained", ("plate_2",))
    assert trace.steps[-1].message.startswith("rag_1 removes stain only when it is soaked with ")
    assert "water" in trace.steps[-1].message


def test_wet_cloth_removes_stains(home):
    soaked = f"{TAP}; {RAG}; move sink_1; soak_object_in_source rag_1 sink_1"
    succeeded(home, f"{soaked}; move plate_2; clean_object_with_tool plate_2 rag_1")
    assert home.facts.holds("soaked", ("rag_1",))
    assert home.facts.holds("saturated", ("rag_1", "water.n.06"))
    assert not home.facts.holds("covered", ("plate_2", "stain.n.01"))


def test_soap_from_a_bottle_removes_stains(home):
    text = f"{RAG}; move liquid_soap__bottle_1; soak_object_in_source rag_1 liquid_soap__bottle_1"
    succeeded(home, f"{text}; move plate_2; clean_object_with_tool plate_2 rag_1")
    assert not home.facts.holds("soaked", ("rag_1",))
    assert home.facts.holds("saturated", ("rag_1", "liquid_soap.n.01"))
    assert not home.facts.holds("stained", ("plate_2",))


def test_cup_is_filled_from_a_bottle_or_a_tap_and_wet_only_by_water(home):
    text = "move cup_1; pick_up cup_1; move liquid_soap__bottle_1; soak_object_in_source cup_1 liquid_soap__bottle_1"
    poured = succeeded(home, text)
    assert (
        poured.steps[-1].message
        == "held cup_1 under the running liquid; cup_1 is now filled with liquid soap"
    )
    assert home.facts.holds("filled", ("cup_1", "liquid_soap.n.01"))
    assert not home.facts.holds("saturated", ("cup_1", "liquid_soap.n.01"))
    succeeded(home, f"{TAP}; move cup_1; pick_up cup_1; move sink_1; soak_object_in_source cup_1 sink_1")
    assert home.facts.holds("soaked", ("cup_1",))
    assert home.facts.holds("filled", ("cup_1", "water.n.06"))


def test_object_in_a_running_sink_is_soaked_filled_and_washed_at_once(home):
    rag = succeeded(home, f"{TAP}; {RAG}; move sink_1; place sink_1 inside")
    assert rag.steps[-1].message == "put rag_1 inside sink_1; rag_1 is now soaked"
    succeeded(home, "move cup_1; pick_up cup_1; move sink_1; place sink_1 inside; toggle_on sink_1")
    assert home.facts.holds("filled", ("cup_1", "water.n.06"))
    assert home.facts.holds("contains", ("cup_1", "water.n.06")), "what is filled with water contains it"
    plate = succeeded(
        home,
        f"{TAP}; move plate_2; pick_up plate_2; move sink_1; place sink_1 inside; "
        "clean_object_with_tool plate_2 sink_1",
    )
    assert not home.facts.holds("stained", ("plate_2",))
    assert not home.facts.holds("soaked", ("plate_2",)), "a plate takes up no water"
    assert plate.steps[-2].message == "put plate_2 inside sink_1; plate_2 is now free of stain"


DISHES = "move dishwasher_1; open dishwasher_1; move plate_2; pick_up plate_2; move dishwasher_1; place dishwasher_1 inside"


def test_dishwasher_washes_when_closed_and_on(home):
    succeeded(home, f"{DISHES}; close dishwasher_1")
    assert home.facts.holds("stained", ("plate_2",))
    succeeded(
        home,
        f"{DISHES}; close dishwasher_1; toggle_on dishwasher_1; clean_object_with_tool plate_2 dishwasher_1",
    )
    assert not home.facts.holds("stained", ("plate_2",))


def test_slicing_is_deterministic_and_a_reset_restores_the_melon(home):
    first = executed(home, MELON, seed=3)
    again = executed(home, MELON, seed=3)
    assert first == again
    executed(home, "turn 1")
    assert home.facts.holds("real", ("melon_1",))
    assert not home.facts.holds("real", ("half_melon_1",))
    assert home.facts.holds("dusty", ("plate_1",))


def test_dust_is_part_of_the_digest(home):
    wiped = f"{RAG}; move plate_1; clean_object_with_tool plate_1 rag_1"
    other = f"{RAG}; move plate_1; turn 0"
    assert executed(home, wiped).digest != executed(home, other).digest


def test_every_household_skill_is_covered(home):
    used = {
        call.skill
        for text in (
            MELON,
            f"{RAG}; soak_object_in_source rag_1 sink_1; clean_object_with_tool plate_1 rag_1",
        )
        for call in plan_of(task_over(home.world.scene), text)
    }
    assert set(PROFILES[Profile.HOUSEHOLD]) - set(PROFILES[Profile.PAPER]) == used - {
        Skill.MOVE,
        Skill.PICK_UP,
    }


CALLS = st.sampled_from(
    [
        "move table_knife_1",
        "pick_up table_knife_1",
        "move melon_1",
        "slice_object_with_tool melon_1 table_knife_1",
        "slice_object_with_tool loaf_1 table_knife_1",
        "move breakfast_table_1",
        "place breakfast_table_1 ontop",
        "move rag_1",
        "pick_up rag_1",
        "move sink_1",
        "toggle_on sink_1",
        "soak_object_in_source rag_1 sink_1",
        "place sink_1 inside",
        "move plate_2",
        "clean_object_with_tool plate_2 rag_1",
        "pick_up half_melon_1",
    ]
)


@settings(max_examples=25, deadline=None)
@given(st.lists(CALLS, min_size=1, max_size=14))
def test_reset_undoes_slicing_and_cleaning_to_the_bit(home, calls):
    task = task_over(home.world.scene)
    home.reset(task, 0)
    before = home.world.state_bytes()
    for call in plan_of(task, "; ".join(calls)):
        home.run_step(call)  # those that fail change nothing, and the next one is tried
    home.reset(task, 0)
    assert home.world.state_bytes() == before


@settings(max_examples=25, deadline=None)
@given(st.lists(CALLS, min_size=1, max_size=14))
def test_failed_call_changes_nothing(home, calls):
    task = task_over(home.world.scene)
    home.reset(task, 0)
    for call in plan_of(task, "; ".join(calls)):
        before = home.world.state_bytes()
        if not home.run_step(call).ok:
            assert home.world.state_bytes() == before
