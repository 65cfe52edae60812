"""Rule-based social simulation: casts that cover the scene, changing requests, instructions that name a user."""

import dataclasses
import re
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.casting import HOBBIES, NAMES, draw_cast
from embomatrix.factory.social.fitting import is_plausible, reasons_for, themes_of
from embomatrix.factory.social.occasions import Theme, occasion_of, occasions, occasions_in
from embomatrix.factory.social.phrases import (
    CLAUSES,
    MANNER_CLAUSES,
    NEEDS,
    NOUNS,
    TURNS,
    room_called,
    shorten_repeated_rooms,
    spoken_category,
)
from embomatrix.factory.social.values import ROBOT, Act, Cast, DaySlot, Person
from embomatrix.factory.social.writer import SocialWriter
from embomatrix.factory.writer.goals import GoalConjunct
from embomatrix.factory.writer.tasks import DraftOrder
from embomatrix.factory.writer.variant import build_variant
from embomatrix.factory.writer.words import PHRASES
from embomatrix.world.catalog import Catalog
from embomatrix.world.goal import And, Atom
from embomatrix.world.task import TaskCategory

SCENE = build_base_scene("Rs_int", seed=0)
ROOMS = tuple(room.name for room in SCENE.rooms)


@pytest.fixture(scope="module")
def drafts():
    """Return the drafts of one variant with its view."""
    rng = np.random.default_rng(5)
    variant = build_variant(SCENE, ROOMS[:4], "Rs_int-talk", rng)
    view, writer = SceneView(variant.scene), SocialWriter(seed=2)
    categories = list(TaskCategory)
    found = [writer.write(variant, view, DraftOrder(categories[at % 4], f"t{at}", rng)) for at in range(60)]
    return [draft for draft in found if draft is not None], writer.cast_of(SCENE)


@settings(max_examples=30)
@given(st.integers(0, 2**32))
def test_every_room_has_a_person_and_ties_are_mutual(seed):
    cast = draw_cast(SCENE, np.random.default_rng(seed))
    assert set(ROOMS) <= cast.rooms
    for person in cast.people:
        for other in person.ties:
            assert person.name in cast.of(other).ties
    assert all(earlier.time <= later.time for earlier, later in pairwise(cast.day))


@settings(max_examples=30)
@given(st.integers(0, 2**32))
def test_every_activity_of_a_room_has_a_person(seed):
    cast = draw_cast(SCENE, np.random.default_rng(seed))
    done = {(slot.room, slot.activity) for slot in cast.day}
    for room in SCENE.rooms:
        for occasion in occasions_in(room.type):
            suited = any(occasion.suits(person) for person in cast.people)
            assert ((room.name, occasion.doing) in done) == suited


@settings(max_examples=50)
@given(st.integers(0, 2**32))
def test_parents_are_a_generation_older_and_setting_matches_the_household(seed):
    cast = draw_cast(SCENE, np.random.default_rng(seed))
    first = cast.people[0]
    ties = {tie for person in cast.people[1:] for tie in person.ties.values()}
    for person in cast.people[1:]:
        if person.ties[first.name] == "child":
            assert first.age - person.age >= 18
        if person.ties[first.name] == "parent":
            assert person.age - first.age >= 18
    assert ("lodger" in cast.setting) <= ("lodger" in ties)
    assert ("generations" in cast.setting) == ({"parent", "child"} <= ties)


@pytest.mark.parametrize(
    "base", ["restaurant_diner", "school_gym", "office_bike", "hotel_gym_spa", "grocery_store_cafe"]
)
def test_other_scenes_have_other_casts(base):
    scene = build_base_scene(base, seed=0)
    cast = draw_cast(scene, np.random.default_rng(0))
    assert {room.name for room in scene.rooms} <= cast.rooms
    assert {person.job for person in cast.people}.isdisjoint({"pensioner", "lodger"})


def test_equal_seeds_give_a_scene_the_same_cast():
    assert SocialWriter(3).cast_of(SCENE) == SocialWriter(3).cast_of(SCENE)
    assert SocialWriter(3).cast_of(SCENE) != SocialWriter(4).cast_of(SCENE)


def test_nearly_every_category_yields_drafts(drafts):
    found, _ = drafts
    assert len(found) >= 40
    assert {draft.task.category for draft in found} == set(TaskCategory)


def test_instruction_names_a_person_and_the_confirmed_wishes(drafts):
    found, cast = drafts
    for draft in found:
        assert any(name in draft.task.instruction for name in cast.names)
        assert draft.transcript.startswith(f"# {draft.task.instruction}\n")
        assert not re.search(r"[{}]|  |\.\.", draft.task.instruction)
        last_turn = draft.transcript.split("## What is to be true")[0].strip().splitlines()[-1]
        assert last_turn.startswith("**Robot** (confirm)")


def test_requests_change_during_the_conversation(drafts):
    found, _ = drafts
    amended = [draft for draft in found if "(amend)" in draft.transcript]
    refused = [draft for draft in found if "(refuse)" in draft.transcript]
    assert len(amended) >= len(found) // 8
    assert len(refused) >= len(found) // 8


def test_equal_generators_write_equal_tasks():
    def written():
        rng = np.random.default_rng(9)
        variant = build_variant(SCENE, ROOMS[:3], "Rs_int-same", rng)
        draft = SocialWriter(1).write(
            variant, SceneView(variant.scene), DraftOrder(TaskCategory.COMPOUND, "t", rng)
        )
        return draft.task.instruction, draft.transcript, draft.signature

    assert written() == written()


def test_every_predicate_of_the_plain_writer_has_social_phrases():
    assert set(CLAUSES) == set(PHRASES)
    assert all(len(set(options)) >= 4 for options in CLAUSES.values())
    assert set(TURNS) == set(Act)
    assert len(set(NAMES)) == len(NAMES)
    assert len(set(HOBBIES)) >= 5


def test_everyday_names_of_categories_are_unique():
    names = Counter(spoken_category(name) for name in Catalog.load().category_names)
    assert {
        spoken_category(name): names[spoken_category(name)]
        for name in NOUNS
        if names[spoken_category(name)] > 1
    } == {}
    assert set(NOUNS) <= set(Catalog.load().category_names)


def test_taps_are_turned_and_drawers_pulled_out(drafts):
    assert {key.rpartition(" ")[0] for key in MANNER_CLAUSES} <= set(CLAUSES)
    assert set(MANNER_CLAUSES) <= set(NEEDS)
    found, _ = drafts
    for draft in found:
        assert not re.search(r"sinks? (over )?(in [\w ]+ )?(switched )?(on|off)\b", draft.task.instruction)
        assert "bottom cabinet" not in draft.task.instruction
    assert any("tap" in draft.task.instruction or "water" in draft.task.instruction for draft in found)


ANN = Person(name="Ann", age=40, job="nurse", hobby="chess")
BO = Person(name="Bo", age=9, job="pupil", hobby="football", ties={"Ann": "child"})
SLOT = DaySlot(time="07:30", person="Ann", room="kitchen_0", activity="making breakfast")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"people": (ANN, ANN)}, "two people have the name 'Ann'"),
        (
            {"people": (BO, ANN.model_copy(update={"name": "Cy"}))},
            "Bo has a tie to 'Ann': expected another person of",
        ),
        ({"day": (SLOT.model_copy(update={"person": "Zed"}),)}, "the slot at 07:30 names 'Zed'"),
        ({"people": (ANN,)}, "at least 2 items"),
        ({"day": ()}, "at least 1 item"),
    ],
)
def test_inconsistent_cast_is_rejected(values, sentence):
    whole = {"setting": "a home", "people": (ANN, BO), "day": (SLOT,)}
    with pytest.raises(ValidationError, match=sentence):
        Cast(**{**whole, **values})


@pytest.mark.parametrize("time", ["7:30", "24:00", "12:60", "noon"])
def test_time_of_day_needs_four_digits(time):
    with pytest.raises(ValidationError, match="time"):
        DaySlot(time=time, person="Ann", room="kitchen_0", activity="eating")


def test_robot_is_not_part_of_the_cast():
    assert ROBOT not in NAMES


def test_every_activity_has_reasons_and_every_theme_occurs():
    found = [occasion for each in occasions().values() for occasion in each]
    assert {theme for occasion in found for theme in occasion.themes} == set(Theme)
    assert all(occasion_of(occasion.doing).doing == occasion.doing for occasion in found)
    assert not [why for occasion in found for why in occasion.why if why[0].isupper() or why.endswith(".")]


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.sampled_from(["Rs_int", "shop"]))
def test_activities_suit_age_and_place(seed, base):
    cast = draw_cast(
        dataclasses.replace(SCENE, base="grocery_x" if base == "shop" else base), np.random.default_rng(seed)
    )
    for slot in cast.day:
        occasion = occasion_of(slot.activity)
        assert occasion.suits(cast.of(slot.person))
        assert base == "Rs_int" or not occasion.private


def test_wishes_suit_the_activity(drafts):
    found, cast = drafts
    doing = {slot.activity for slot in cast.day}
    kitchen_work = [draft for draft in found if draft.task.category is TaskCategory.KITCHEN_OPERATION]
    for draft in kitchen_work:
        (activity,) = [each for each in doing if f"is {each}\n" in draft.transcript]
        assert occasion_of(activity).themes & {Theme.COOKING, Theme.MEALS}
    assert kitchen_work


@pytest.mark.parametrize(
    ("thing", "host", "room", "inside"),
    [
        ("comb", "bar", "bar", False),
        ("clipboard", "urinal", "bathroom", True),
        ("envelope", "multi_station_furniture_sink", "bathroom", False),
        ("hardback", "wall_mounted_sink", "bathroom", True),
        ("pillar_candle", "bed", "bedroom", False),
        ("chopping_board", "bottom_cabinet", "meeting_room", True),
        ("mug", "oven", "kitchen", True),
        ("wineglass", "fridge", "kitchen", True),
        ("cell_phone", "swivel_chair", "private_office", False),
        ("tablefork", "console_table", "corridor", False),
        ("radio", "top_cabinet", "bathroom", True),
        ("teddy_bear", "shelf", "bathroom", False),
        ("apple", "bookcase", "living_room", True),
        ("potato", "piano", "living_room", False),
        ("pear", "microwave", "kitchen", False),
        ("envelope", "printer", "private_office", False),
        ("vase", "eames_chair", "break_room", False),
        ("broccoli", "dish_rack_cart", "kitchen", True),
        ("bar_soap", "sauna_heater", "sauna", False),
    ],
)
def test_implausible_places_are_rejected(thing, host, room, inside):
    assert not is_plausible(thing, host, room, inside=inside)


def test_usual_places_are_plausible():
    assert is_plausible("apple", "furniture_sink", "kitchen", inside=True)
    assert is_plausible("teddy_bear", "bed", "bedroom", inside=False)
    assert is_plausible("carton_of_milk", "fridge", "kitchen", inside=True)
    assert is_plausible("mug", "desk", "private_office", inside=False)
    assert is_plausible("carton_of_milk", "microwave", "kitchen", inside=False)


@dataclasses.dataclass(frozen=True)
class Flat:
    """Scene view in which each object is named after its category and is in the kitchen."""

    scene = dataclasses.replace(SCENE, rooms=tuple(room for room in SCENE.rooms if room.type == "kitchen"))

    def category(self, name):
        return name

    def room(self, _name):
        return self.scene.rooms[0].name


@pytest.mark.parametrize(
    ("thing", "wanted"), [("salt_shaker", False), ("blender", True), ("pay_phone", False)]
)
def test_salt_shaker_is_never_switched_on(thing, wanted):
    piece = GoalConjunct(
        Atom("toggled_on", (thing,)), "", (thing,), (f"toggled_on({thing})",), "switch", "it"
    )
    assert bool(themes_of(piece, Flat())) == wanted


def test_tidying_person_does_not_ask_for_running_water():
    sinks = [name for name in Catalog.load().used_categories if name.endswith("_sink")]
    assert sinks
    for sink in sinks:
        sign = f"toggled_on({sink})"
        piece = GoalConjunct(Atom("toggled_on", (sink,)), "", (sink,), (sign,), "switch", "it", manner="tap")
        assert Theme.TIDYING not in themes_of(piece, Flat()), sink


@pytest.mark.parametrize(
    ("state", "relation", "host", "wanted"),
    [
        ("cooked", "inside", "bottom_cabinet", False),
        ("hot", "inside", "wicker_basket", False),
        ("hot", "inside", "microwave", True),
        ("cooked", "ontop", "countertop", True),
        ("frozen", "inside", "microwave", False),
        ("frozen", "inside", "freezer", True),
    ],
)
def test_hot_food_is_served_and_frozen_food_stays_cold(state, relation, host, wanted):
    goal = And((Atom(state, ("potato",)), Atom(relation, ("potato", host))))
    signs = (f"{state}(potato)", f"{relation}(potato,{host})")
    piece = GoalConjunct(goal, "", ("potato", "stove", host), signs, "thermal", "the potato")
    assert bool(themes_of(piece, Flat())) == wanted


def test_room_names_are_natural_and_shortened_when_repeated():
    two = dataclasses.replace(
        SCENE, rooms=(*SCENE.rooms, dataclasses.replace(SCENE.rooms[0], name="bedroom_1", type="bedroom"))
    )
    view = SceneView(two)
    rooms = {room_called(view, room.name) for room in two.rooms}
    assert {"bedroom 0", "bedroom 1", "the kitchen"} <= rooms
    for text, once in (
        (
            "As Ann rests in the kitchen, open the oven in the kitchen.",
            "As Ann rests in the kitchen, open the oven there.",
        ),
        ("Put the mug from bedroom 1 over in bedroom 1.", "Put the mug from bedroom 1 over there."),
        (
            "Leave bedroom 0, put the mug from bedroom 0 in the box in bedroom 0.",
            "Leave bedroom 0, put the mug from there in the box.",
        ),
        (
            "Open a door in bedroom 0, then one in bedroom 1.",
            "Open a door in bedroom 0, then one in bedroom 1.",
        ),
        (
            "The lamp in bedroom 1; then the one in bedroom 10.",
            "The lamp in bedroom 1; then the one in bedroom 10.",
        ),
    ):
        assert shorten_repeated_rooms(text, view) == once


def test_unknown_activity_has_no_reasons():
    assert reasons_for("juggling eels") == ()
    assert "the chain is off" in reasons_for("mending a bicycle")
