"""Prompts: scene tree, unique names, and examples that parse."""

from dataclasses import replace

import pytest
from tests.fakes.household import household_scene
from tests.fakes.plans import task_over

from embomatrix.skills.parse import parse_plan
from embomatrix.skills.prompt import (
    EXAMPLES,
    Codec,
    PromptRow,
    Situation,
    labels,
    limited,
    plan_in_names,
    prompt_for,
    situation_of,
    subset,
    with_indices,
)
from embomatrix.skills.syntax import PROFILES, PlaceRelation, Skill, SkillCall
from embomatrix.world.state import Relation
from embomatrix.world.task import Profile

FRIDGE = PromptRow(2, "fridge_1", "fridge", "kitchen_0", states=("closed",), fixed=True)
COUNTER = PromptRow(0, "countertop_1", "countertop", "kitchen_0", fixed=True)
OVEN = PromptRow(6, "oven_1", "oven", "kitchen_0", states=("closed", "off"), fixed=True)
APPLE = PromptRow(4, "apple_1", "apple", "kitchen_0", "countertop_1", Relation.ONTOP)
LEG = PromptRow(1, "chicken_leg_1", "chicken_leg", "kitchen_0", "fridge_1", Relation.INSIDE, ("frozen",))
BOWL = PromptRow(3, "bowl_1", "bowl", "kitchen_0", "countertop_1", Relation.ONTOP)
OTHER_BOWL = PromptRow(5, "bowl_2", "bowl", "den_0")
SITUATION = Situation(
    ("kitchen_0", "den_0"),
    "den_0",
    (COUNTER, LEG, FRIDGE, BOWL, APPLE, OTHER_BOWL, OVEN),
    "Put the apple into the fridge.",
    7,
)


def test_names_prompt_lists_rooms_furniture_contents_and_states():
    assert prompt_for(SITUATION, Codec.NAMES).user.splitlines() == [
        "room kitchen_0",
        "countertop on bowl_1 apple",
        "fridge closed in chicken_leg frozen",
        "oven closed off",
        "room den_0",
        "bowl_2",
        "robot den_0",
        "task Put the apple into the fridge.",
    ]


def test_indexed_prompt_puts_the_name_before_the_index():
    user = prompt_for(SITUATION, Codec.LINES).user
    assert "fridge 2 closed in: chicken leg 1 frozen" in user
    assert "countertop 0 on: bowl 3, apple 4" in user
    assert user.endswith("Robot: den_0, hand empty\nTask: Put the apple into the fridge.")


@pytest.mark.parametrize("codec", [Codec.LINES, Codec.JSON])
def test_system_text_lists_every_skill_and_the_example_of_its_codec(codec):
    for profile in Profile:
        system = prompt_for(replace(SITUATION, profile=profile), codec).system
        assert [skill for skill in Skill if skill.value in system] == [*PROFILES[profile]]
        assert EXAMPLES[codec] in system


@pytest.mark.parametrize("codec", Codec)
def test_example_of_every_codec_parses_to_the_same_plan(codec):
    text = EXAMPLES[codec]
    plan = parse_plan(with_indices(text, SITUATION) if codec is Codec.NAMES else text)
    assert plan == parse_plan(EXAMPLES[Codec.JSON])
    assert [call.skill for call in plan][:3] == [Skill.MOVE, Skill.OPEN, Skill.MOVE]


def test_name_is_shortened_only_if_unique():
    assert labels(SITUATION) == {
        0: "countertop",
        1: "chicken_leg",
        2: "fridge",
        3: "bowl_1",
        4: "apple",
        5: "bowl_2",
        6: "oven",
    }


def test_every_kind_of_call_round_trips_through_the_names_codec():
    plan = (
        SkillCall(Skill.GO_TO_ROOM, room_name="kitchen_0"),
        SkillCall(Skill.MOVE, object_index=3),
        SkillCall(Skill.PLACE, object_index=2, relation=PlaceRelation.INSIDE),
        SkillCall(Skill.HEAT, object_index=1, source_index=6),
        SkillCall(Skill.TURN, yaw=1.57),
        SkillCall(Skill.MOVE_FORWARD, distance=0.5, yaw=-1.57),
    )
    text = plan_in_names(plan, SITUATION)
    assert text.splitlines()[3] == "heat_object_with_source chicken_leg oven"
    assert parse_plan(with_indices(text, SITUATION)) == plan


def test_full_names_are_accepted_beside_short_ones():
    assert with_indices("move apple_1", SITUATION) == with_indices("move apple", SITUATION) == "move 4"


def test_unknown_name_parses_to_an_index_outside_the_table():
    assert parse_plan(with_indices("move unicorn", SITUATION)) == (SkillCall(Skill.MOVE, object_index=7),)


@pytest.mark.parametrize("text", ["", "hello there", "fly apple"])
def test_text_without_a_plan_is_unchanged(text):
    assert with_indices(text, SITUATION) == text


def test_limit_keeps_named_rows_and_their_hosts():
    reduced = limited(SITUATION, 3)
    assert {row.name for row in reduced.rows} == {"apple_1", "fridge_1", "countertop_1"}
    assert limited(SITUATION, 7) is SITUATION


def test_limit_ignores_names_inside_other_words():
    reduced = limited(
        Situation(
            (),
            "",
            (OTHER_BOWL, PromptRow(8, "tablebowls_1", "ta", "den_0"), APPLE),
            "fetch an apple table",
            9,
        ),
        1,
    )
    assert [row.name for row in reduced.rows] == ["apple_1"]


def test_contents_of_an_omitted_row_are_listed_in_the_room():
    reduced = subset(SITUATION, {4, 2})
    assert prompt_for(reduced, Codec.NAMES).user.splitlines()[:3] == [
        "room kitchen_0",
        "fridge closed",
        "apple",
    ]


def test_prompt_never_contains_the_goal():
    for codec in Codec:
        prompt = prompt_for(SITUATION, codec)
        assert "inside(" not in prompt.system + prompt.user


def test_prompt_shows_substances_and_absent_objects():
    scene = household_scene()
    situation = situation_of(scene, replace(task_over(scene), profile=Profile.HOUSEHOLD))
    states = {row.name: row.states for row in situation.rows}
    assert states["plate_1"] == ("dusty",)
    assert states["plate_2"] == ("stained",), "a covering with a dedicated word is described by that word"
    assert states["liquid_soap__bottle_1"] == ("filled_with_liquid_soap",)
    assert states["half_melon_1"] == ("absent",)
    assert situation.profile is Profile.HOUSEHOLD
