"""Observations in words."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.skills.describe import (
    MAX_FINAL_LINES,
    ObjectDescription,
    done,
    final_lines,
    gained,
    line,
    listed,
    read_line,
)
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.state import Relation


def test_description_contains_host_room_and_states():
    item = ObjectDescription("apple_1", "kitchen_0", "bowl_1", Relation.INSIDE, states=("cooked", "hot"))
    assert line(item) == "apple_1: inside bowl_1 in kitchen_0, cooked, hot"


def test_contents_of_a_carried_basket_are_described_inside_it():
    apple = ObjectDescription("apple_1", "kitchen_0", "basket_1", Relation.INSIDE, held=True)
    assert line(apple) == "apple_1: inside basket_1 in the robot's hand"
    assert line(ObjectDescription("basket_1", "kitchen_0", held=True)) == "basket_1: in the robot's hand"


def test_object_on_the_floor_is_described_with_its_room():
    assert (
        line(ObjectDescription("fridge_1", "kitchen_0", states=("closed",)))
        == "fridge_1: in kitchen_0, closed"
    )


def test_place_message_names_object_and_destination():
    call = SkillCall(Skill.PLACE, object_index=3, relation=PlaceRelation.ONTOP)
    assert done(call, target="table_1", held="apple_1") == "put apple_1 on top of table_1"


def test_lists_read_like_sentences():
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "nothing",
        "a",
        "a and b",
        "a, b and c",
    ]


def test_new_temperature_states_are_listed_by_object():
    assert gained({"apple_1": ["hot", "cooked"], "mug_1": ["hot"]}) == (
        "apple_1 is now hot and cooked; mug_1 is now hot"
    )


def test_long_final_description_is_cut_with_a_remark():
    described = [ObjectDescription(f"apple_{n}", "kitchen_0") for n in range(MAX_FINAL_LINES + 3)]
    lines = final_lines(described)
    assert len(lines) == MAX_FINAL_LINES + 1
    assert lines[-1] == "and 3 more objects"
    assert final_lines(described[:2]) == ("apple_0: in kitchen_0", "apple_1: in kitchen_0")


NAMES = st.from_regex(r"[a-z]{1,8}(_[a-z]{1,5})?_[0-9]{1,2}", fullmatch=True)
STATES = st.lists(st.sampled_from(["open", "closed", "on", "hot", "covered with dust", "soaked"]), max_size=3)


@given(
    st.builds(
        ObjectDescription,
        NAMES,
        st.just("") | NAMES,
        st.just("") | NAMES,
        st.sampled_from(Relation),
        st.booleans(),
        st.just(value=False),
        STATES.map(tuple),
    )
)
def test_description_is_read_back(item):
    read = read_line(line(item))
    expected = dataclasses.replace(
        item, room="" if item.held else item.room, relation=item.relation if item.host else None
    )
    assert read == expected


def test_object_that_is_gone_is_read_back():
    assert read_line(line(ObjectDescription("apple_1", "kitchen_0", gone=True))) == ObjectDescription(
        "apple_1", "", gone=True
    )


@pytest.mark.parametrize("text", ["", "and 3 more objects", "apple_1", "apple_1: somewhere", "apple_1: in "])
def test_other_lines_describe_no_object(text):
    with pytest.raises(ValueError, match="does not describe an object"):
        read_line(text)
