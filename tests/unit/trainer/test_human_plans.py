"""Conversion of two-handed human plans to one arm: objects are fetched when needed, and doors closed at the end."""

import json

import pytest
from tests.fakes.human_plans import InexpressibleError, from_eai

from embomatrix.skills.syntax import PlaceRelation

TABLE = ("fridge_1", "apple_1", "milk_1", "table_1", "rag_1", "chair_1", "sink_1")
NAMES = dict(zip(TABLE, ("fridge", "apple", "milk", "table", "rag", "chair", "sink"), strict=True))
HOMES = {"rag_1": ("table_1", PlaceRelation.ONTOP), "apple_1": ("fridge_1", PlaceRelation.INSIDE)}


def converted(*steps):
    text = json.dumps([{"action": action, "object": names} for action, names in steps])
    words = []
    for call in from_eai(text, TABLE, NAMES, HOMES):
        source = [] if call.source_index is None else [TABLE[call.source_index]]
        relation = [call.relation.value] if call.relation else []
        words.append(" ".join([call.skill.value, TABLE[call.object_index], *source, *relation]))
    return words


def test_two_objects_are_carried_in_turn_before_the_door_is_closed():
    steps = (
        *(("OPEN", "fridge"), ("LEFT_GRASP", "apple"), ("RIGHT_GRASP", "milk"), ("CLOSE", "fridge")),
        *(("LEFT_PLACE_ONTOP", "table"), ("RIGHT_PLACE_ONTOP", "table")),
    )
    assert converted(*steps) == [
        "open fridge_1",
        "pick_up apple_1",
        "place table_1 ontop",
        "pick_up milk_1",
        "place table_1 ontop",
        "close fridge_1",
    ]


def test_tool_is_put_back_before_the_hand_is_needed():
    steps = (("RIGHT_GRASP", "rag"), ("LEFT_GRASP", "chair"), ("CLEAN", "chair"), ("OPEN", "fridge"))
    assert converted(*steps) == [
        "pick_up rag_1",
        "clean_object_with_tool chair_1 rag_1",
        "place table_1 ontop",
        "open fridge_1",
    ]


def test_soaked_object_is_held_under_its_sink():
    steps = (("RIGHT_GRASP", "rag"), ("RIGHT_PLACE_INSIDE", "sink"), ("TOGGLE_ON", "sink"), ("SOAK", "rag"))
    assert converted(*steps)[2:] == [
        "toggle_on sink_1",
        "pick_up rag_1",
        "soak_object_in_source rag_1 sink_1",
    ]


def test_object_left_on_the_floor_is_put_back():
    steps = (("RIGHT_GRASP", "rag"), ("CLEAN", "chair"), ("RIGHT_PLACE_ONTOP", "room_floor_kitchen_0"))
    assert converted(*steps)[2:] == ["place table_1 ontop"]


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (("RIGHT_PLACE_NEXTTO", "table"), "RIGHT_PLACE_NEXTTO"),
        (("OPEN", "window"), "window"),
        (("CLEAN", "chair"), "a tool that lies in a sink"),
        (("SOAK", "milk"), "SOAK outside of a sink"),
        (("RIGHT_PLACE_ONTOP", "table"), "an empty hand"),
    ],
)
def test_step_without_a_matching_skill_is_reported(step, words):
    with pytest.raises(InexpressibleError, match=words):
        converted(step)
