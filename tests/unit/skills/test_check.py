"""Preconditions in a symbolic world without engine and geometry, one rule at a time."""

from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes import household
from tests.fakes.skill_reasons import reasons_of

from embomatrix.skills.check import check
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.skills.view import ObjectReach
from embomatrix.world.asset import Asset
from embomatrix.world.state import SubstanceFact, SubstanceRelation

ASSETS = {
    "apple": make.apple(),
    "bowl": make.bowl(),
    "fridge": make.fridge(),
    "microwave": make.microwave(),
    "stove": make.stove(),
    "table": make.kitchen_table(),
}
TABLE = tuple(ASSETS)
AT_HAND = ObjectReach(0.5, 0.8)


@dataclass
class WordWorld:
    """World in which every object is in reach, closed, off and empty by default."""

    table: tuple[str, ...] = TABLE
    rooms: tuple[str, ...] = ("kitchen_0", "bedroom_0")
    carried: tuple[str, ...] = ()
    assets: dict[str, Asset] = field(default_factory=lambda: dict(ASSETS))
    open: set[str] = field(default_factory=set)
    on: set[str] = field(default_factory=set)
    inside: dict[str, str] = field(default_factory=dict)
    burdens: dict[str, str] = field(default_factory=dict)
    reaches: dict[str, ObjectReach] = field(default_factory=dict)
    hidden: set[str] = field(default_factory=set)
    at: set[tuple[str, str]] = field(default_factory=set)
    absent: set[str] = field(default_factory=set)
    sliced: set[str] = field(default_factory=set)
    facts: dict[str, frozenset[SubstanceFact]] = field(default_factory=dict)

    def asset(self, name):
        return self.assets[name]

    def is_fixed(self, name):
        return name in {"fridge", "microwave", "stove", "table"}

    def is_open(self, name):
        return name in self.open

    def is_on(self, name):
        return name in self.on

    def cargo(self, name):
        return (name, *(item for item, host in self.inside.items() if host == name))

    def burden(self, name):
        return self.burdens.get(name, "")

    def closed_around(self, name):
        host = self.inside.get(name, "")
        return host if host and self.asset(host).joints and host not in self.open else ""

    def reach(self, name):
        return self.reaches.get(name, AT_HAND)

    def is_approachable(self, name):
        return name not in self.hidden

    def is_at(self, name, source):
        return (name, source) in self.at

    def is_real(self, name):
        return name not in self.absent

    def is_sliced(self, name):
        return name in self.sliced

    def is_inside(self, name, container):
        return self.inside.get(name) == container

    def facts_about(self, name):
        return self.facts.get(name, frozenset())


def call(skill, target="", source="", relation=None):
    return SkillCall(
        skill,
        object_index=TABLE.index(target) if target else None,
        source_index=TABLE.index(source) if source else None,
        relation=relation,
    )


def reason(world, skill, *args, **kwargs):
    refusal = check(world, call(skill, *args, **kwargs))
    return refusal.reason if refusal else None


def test_call_with_valid_preconditions_is_accepted():
    assert reason(WordWorld(), Skill.PICK_UP, "apple") is None


@pytest.mark.parametrize("index", [-1, len(TABLE), 10**15])
def test_index_outside_the_table_is_refused_with_the_valid_range(index):
    refusal = check(WordWorld(), SkillCall(Skill.MOVE, object_index=index))
    assert refusal.reason is FailureReason.UNKNOWN_INDEX
    assert refusal.sentence == f"there is no object with index {index}: the table has indices 0 to 5"


def test_unknown_room_is_refused_with_the_list_of_rooms():
    refusal = check(WordWorld(), SkillCall(Skill.GO_TO_ROOM, room_name="attic"))
    assert refusal.sentence == "there is no room attic: the rooms are kitchen_0, bedroom_0"


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_drives_up_to_five_metres_in_both_directions_are_allowed(distance):
    refused = check(WordWorld(), SkillCall(Skill.MOVE_FORWARD, distance=distance, yaw=0.0)) is not None
    assert refused == (abs(distance) > ROBOT.max_step_m)


def test_reach_is_checked_to_the_centimetre():
    near = WordWorld(reaches={"apple": ObjectReach(ROBOT.reach_m, 0.8)})
    far = WordWorld(reaches={"apple": ObjectReach(ROBOT.reach_m + 0.01, 0.8)})
    assert reason(near, Skill.PICK_UP, "apple") is None
    assert check(far, call(Skill.PICK_UP, "apple")).sentence == (
        "apple is 1.11 m away and the arm reaches 1.10 m: move to it first"
    )


def test_object_above_reach_is_too_high_not_too_far():
    world = WordWorld(reaches={"apple": ObjectReach(3.0, 2.3)})
    assert reason(world, Skill.PICK_UP, "apple") is FailureReason.TOO_HIGH


def test_reach_needs_a_clear_line_of_approach():
    assert reason(WordWorld(hidden={"apple"}), Skill.PICK_UP, "apple") is FailureReason.NO_LINE_OF_APPROACH


def test_contents_of_a_bowl_count_towards_its_mass():
    heavy = {**ASSETS, "apple": replace(ASSETS["apple"], mass_kg=7.7)}
    assert reason(WordWorld(assets=heavy), Skill.PICK_UP, "bowl") is None
    loaded = WordWorld(assets=heavy, inside={"apple": "bowl"})
    assert reason(loaded, Skill.PICK_UP, "bowl") is FailureReason.TOO_HEAVY


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((0.3, 0.9, 0.9), None),
        ((0.31, 0.9, 0.9), FailureReason.TOO_LARGE),
        ((0.1, 0.1, 0.91), FailureReason.TOO_LARGE),
    ],
)
def test_gripper_limit_applies_to_the_smallest_extent(size, expected):
    world = WordWorld(assets={**ASSETS, "apple": replace(ASSETS["apple"], size_m=size)})
    assert reason(world, Skill.PICK_UP, "apple") is expected


def test_object_that_supports_others_is_not_lifted():
    world = WordWorld(burdens={"bowl": "apple"})
    assert check(world, call(Skill.PICK_UP, "bowl")).sentence == "apple rests on bowl: take it off first"


def test_closed_door_blocks_picking_and_placing():
    shut_in = WordWorld(inside={"apple": "fridge"})
    assert reason(shut_in, Skill.PICK_UP, "apple") is FailureReason.CONTAINER_CLOSED
    holding = WordWorld(carried=("apple",))
    assert (
        reason(holding, Skill.PLACE, "fridge", relation=PlaceRelation.INSIDE)
        is FailureReason.CONTAINER_CLOSED
    )


def test_open_door_allows_picking_and_placing():
    world = WordWorld(inside={"apple": "fridge"}, open={"fridge"})
    assert reason(world, Skill.PICK_UP, "apple") is None


def test_top_of_a_closed_fridge_accepts_objects():
    world = WordWorld(carried=("apple",))
    assert reason(world, Skill.PLACE, "fridge", relation=PlaceRelation.ONTOP) is None


def test_running_microwave_is_not_opened_but_running_stove_is_no_obstacle():
    assert reason(WordWorld(on={"microwave"}), Skill.OPEN, "microwave") is FailureReason.OPENED_WHILE_ON
    assert reason(WordWorld(on={"microwave"}), Skill.TOGGLE_OFF, "microwave") is None


def test_microwave_starts_only_when_closed():
    assert reason(WordWorld(open={"microwave"}), Skill.TOGGLE_ON, "microwave") is FailureReason.MUST_BE_CLOSED
    assert reason(WordWorld(), Skill.TOGGLE_ON, "microwave") is None


def test_oven_that_runs_open_may_be_opened_while_it_runs():
    oven = make.microwave()
    assets = {
        **ASSETS,
        "microwave": replace(oven, abilities={**oven.abilities, "toggleable": {"requires_closed": 0.0}}),
    }
    assert reason(WordWorld(assets=assets, on={"microwave"}), Skill.OPEN, "microwave") is None
    opened = WordWorld(assets=assets, on={"microwave"}, open={"microwave"}, at={("apple", "microwave")})
    assert reason(opened, Skill.HEAT, "apple", "microwave") is FailureReason.SOURCE_OPEN


def test_heat_skills_check_food_then_switch_then_door():
    world = WordWorld()
    assert reason(world, Skill.COOK, "apple", "microwave") is FailureReason.NOT_AT_SOURCE
    world.at.add(("apple", "microwave"))
    assert reason(world, Skill.COOK, "apple", "microwave") is FailureReason.SOURCE_OFF
    world.on.add("microwave")
    assert reason(world, Skill.COOK, "apple", "microwave") is None


def test_heat_source_defines_whether_food_lies_inside_or_on_top():
    inside = check(WordWorld(), call(Skill.HEAT, "apple", "microwave")).sentence
    ontop = check(WordWorld(), call(Skill.HEAT, "apple", "stove")).sentence
    assert inside == "apple is not inside microwave: place it there first"
    assert ontop == "apple is not on top of stove: place it there first"


def test_cooking_temperature_depends_on_the_food():
    apple = ASSETS["apple"]
    tough = replace(apple, abilities={**apple.abilities, "cookable": {"cook_temperature": 120.0}})
    world = WordWorld(assets={**ASSETS, "apple": tough}, on={"microwave"}, at={("apple", "microwave")})
    assert check(world, call(Skill.COOK, "apple", "microwave")).sentence == (
        "microwave reaches 100 C and apple needs 120 C: choose a hotter source"
    )


def test_ability_without_temperature_is_no_heat_source():
    stove = replace(ASSETS["stove"], abilities={"heatSource": {}})
    world = WordWorld(assets={**ASSETS, "stove": stove})
    assert reason(world, Skill.HEAT, "apple", "stove") is FailureReason.NOT_A_HEAT_SOURCE


@given(
    skill=st.sampled_from([skill for skill in Skill if skill not in (Skill.TURN, Skill.MOVE_FORWARD)]),
    target=st.integers(-1, len(TABLE)),
    source=st.integers(-1, len(TABLE)),
    relation=st.sampled_from(PlaceRelation),
    carried=st.sampled_from([(), ("apple",), ("bowl", "apple")]),
    opened=st.sets(st.sampled_from(["fridge", "microwave"])),
    running=st.sets(st.sampled_from(["microwave", "stove"])),
)
def test_refusals_use_listed_reasons_and_complete_sentences(
    skill, target, source, relation, carried, opened, running
):
    world = WordWorld(carried=carried, open=opened, on=running, inside={"bowl": "microwave"})
    refusal = check(
        world,
        SkillCall(skill, object_index=target, source_index=source, relation=relation, room_name="kitchen_0"),
    )
    if refusal is not None:
        assert refusal.reason in reasons_of(skill)
        assert "{" not in refusal.sentence


# Cutting, cleaning and soaking.

HOME = {
    "plate": household.plate(),
    "rag": household.rag(),
    "vacuum": household.vacuum(),
    "knife": household.knife(),
    "loaf": household.loaf(),
    "sink": make.sink(),
    "dishwasher": household.dishwasher(),
    "bottle": household.soap_bottle(),
}
COVERED, SATURATED = SubstanceRelation.COVERED, SubstanceRelation.SATURATED


def at_home(**changes):
    return WordWorld(table=tuple(HOME), assets=HOME, **changes)


def home_reason(world, skill, target, source):
    rows = list(HOME)
    refusal = check(world, SkillCall(skill, object_index=rows.index(target), source_index=rows.index(source)))
    return refusal.reason if refusal else None


def covered(substance):
    return {"plate": frozenset({SubstanceFact(COVERED, substance)})}


def soaked(substance):
    return {"rag": frozenset({SubstanceFact(SATURATED, substance)})}


@pytest.mark.parametrize(
    ("substance", "soak", "expected"),
    [
        ("dust.n.01", "", None),
        ("mud.n.03", "", FailureReason.NEEDS_SOAKING),
        ("mud.n.03", "water.n.06", None),
        ("stain.n.01", "water.n.06", None),
        ("stain.n.01", "liquid_soap.n.01", None),
        ("ink.n.01", "water.n.06", FailureReason.NEEDS_SOAKING),
        ("ink.n.01", "vinegar.n.01", None),
        ("house_paint.n.01", "acetone.n.01", None),
        ("rust.n.01", "water.n.06", FailureReason.STAYS_ON),
        ("breadcrumb.n.01", "", None),
        ("red_wine.n.01", "", None),
    ],
)
def test_substances_that_a_rag_removes_depend_on_its_liquid(substance, soak, expected):
    facts = {**covered(substance), **(soaked(soak) if soak else {})}
    world = at_home(carried=("rag",), facts=facts)
    assert home_reason(world, Skill.CLEAN, "plate", "rag") is expected


def test_rag_that_removes_one_of_two_substances_is_accepted():
    facts = {"plate": frozenset(SubstanceFact(COVERED, name) for name in ("dust.n.01", "rust.n.01"))}
    assert home_reason(at_home(carried=("rag",), facts=facts), Skill.CLEAN, "plate", "rag") is None


def test_clean_plate_may_be_wiped():
    assert home_reason(at_home(carried=("rag",)), Skill.CLEAN, "plate", "rag") is None


def test_vacuum_cleaner_works_only_when_on():
    world = at_home(carried=("vacuum",), facts=covered("dust.n.01"))
    assert home_reason(world, Skill.CLEAN, "plate", "vacuum") is FailureReason.SOURCE_OFF
    world.on.add("vacuum")
    assert home_reason(world, Skill.CLEAN, "plate", "vacuum") is None


def test_dishwasher_needs_plate_inside_closed_door_and_switch():
    world = at_home(facts=covered("ink.n.01"))
    assert home_reason(world, Skill.CLEAN, "plate", "dishwasher") is FailureReason.NOT_AT_SOURCE
    world.inside["plate"] = "dishwasher"
    assert home_reason(world, Skill.CLEAN, "plate", "dishwasher") is FailureReason.SOURCE_OFF
    world.on.add("dishwasher")
    assert home_reason(world, Skill.CLEAN, "plate", "dishwasher") is None
    world.open.add("dishwasher")
    assert home_reason(world, Skill.CLEAN, "plate", "dishwasher") is FailureReason.SOURCE_OPEN


def test_running_water_alone_does_not_remove_ink():
    world = at_home(facts=covered("ink.n.01"), inside={"plate": "sink"}, on={"sink"})
    assert home_reason(world, Skill.CLEAN, "plate", "sink") is FailureReason.STAYS_ON
    world.facts = covered("stain.n.01")
    assert home_reason(world, Skill.CLEAN, "plate", "sink") is None


def test_rag_is_soaked_only_in_the_hand_or_in_the_sink():
    world = at_home(on={"sink"})
    assert home_reason(world, Skill.SOAK, "rag", "sink") is FailureReason.NOT_AT_SOURCE
    assert home_reason(at_home(on={"sink"}, carried=("rag",)), Skill.SOAK, "rag", "sink") is None
    assert home_reason(at_home(on={"sink"}, inside={"rag": "sink"}), Skill.SOAK, "rag", "sink") is None


def test_full_bottle_needs_no_switch_and_empty_bottle_gives_nothing():
    full = {"bottle": frozenset({SubstanceFact(SubstanceRelation.FILLED, "liquid_soap.n.01")})}
    assert home_reason(at_home(carried=("rag",), facts=full), Skill.SOAK, "rag", "bottle") is None
    empty = at_home(carried=("rag",))
    assert home_reason(empty, Skill.SOAK, "rag", "bottle") is FailureReason.GIVES_NO_LIQUID


@pytest.mark.parametrize(
    ("liquid", "substance", "expected"),
    [
        ("liquid_soap.n.01", "stain.n.01", None),
        ("liquid_soap.n.01", "dust.n.01", FailureReason.STAYS_ON),
        ("water.n.06", "stain.n.01", FailureReason.STAYS_ON),
        ("red_wine.n.01", "stain.n.01", FailureReason.STAYS_ON),
        ("", "stain.n.01", FailureReason.NOT_A_CLEANER),
    ],
)
def test_soap_in_the_hand_removes_stains_without_a_cloth(liquid, substance, expected):
    held = {SubstanceFact(SubstanceRelation.FILLED, liquid)} if liquid else set()
    world = at_home(carried=("bottle",), facts={**covered(substance), "bottle": frozenset(held)})
    assert home_reason(world, Skill.CLEAN, "plate", "bottle") is expected


def test_bread_is_cut_once_with_the_held_knife():
    assert home_reason(at_home(), Skill.SLICE, "loaf", "knife") is FailureReason.TOOL_NOT_HELD
    assert home_reason(at_home(carried=("knife",)), Skill.SLICE, "loaf", "knife") is None
    again = at_home(carried=("knife",), sliced={"loaf"})
    assert home_reason(again, Skill.SLICE, "loaf", "knife") is FailureReason.ALREADY_SLICED


def test_cut_object_is_no_longer_in_the_world():
    world = at_home(carried=("knife",), absent={"loaf"})
    assert home_reason(world, Skill.SLICE, "loaf", "knife") is FailureReason.NOT_THERE
