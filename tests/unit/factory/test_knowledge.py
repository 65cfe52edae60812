"""Tables of people and events."""

import re

import numpy as np
import pytest

from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.social.household import HELD_OUT_JOBS, draw_cast, is_female, place_of
from embomatrix.factory.social.knowledge import KnowledgeError, _goal_part, _role, events, people_table
from embomatrix.factory.social.wish import FLOOR, Quantity, WishPredicate
from embomatrix.world.catalog import Catalog


def test_needs_are_about_kinds_of_the_catalog_and_their_sentences_about_their_objects() -> None:
    catalog = Catalog.load()
    for event in events():
        for need in event.needs:
            for role in need.roles:
                assert all(kind == FLOOR or catalog.models_of(kind) for kind in role.kinds), need.name
            labels = {role.label for role in need.roles} | {"I", "me", "my", "k", "time"}
            for sentence in need.say:
                plain = re.sub(r"\{[^{}|]*\|[^{}|]*\}", "", sentence)
                assert set(re.findall(r"\{(\w+)\}", plain)) <= labels, (need.name, sentence)


def test_events_are_caused_by_jobs_and_hobbies_that_people_have() -> None:
    table = people_table()
    known = {"pupil", *(job for jobs in table["jobs"].values() for job in jobs)}
    known |= {*table["hobbies"]["all"], *table["children"]["hobbies"]}
    for event in events():
        assert event.of <= known, event.name


def test_the_needs_use_each_quantity_and_predicate() -> None:
    parts = [part for event in events() for need in event.needs for part in need.goal]
    assert {part.quantity for part in parts} == set(Quantity)
    assert {part.predicate for part in parts} == set(WishPredicate)


@pytest.mark.parametrize(
    "line", ["milk carton_of_milk on table", "milk*3: on table", "milk: milk near table"]
)
def test_an_object_in_another_notation_is_quoted_with_what_is_expected(line: str) -> None:
    with pytest.raises(KnowledgeError, match="expected `label: kind @room`"):
        _role(line, {})


@pytest.mark.parametrize("line", ["milk near fridge", "milk", "three mugs on table"])
def test_a_goal_in_another_notation_is_quoted_with_what_is_expected(line: str) -> None:
    with pytest.raises(KnowledgeError, match="expected `milk in fridge`"):
        _goal_part(line)


def test_people_suit_their_place_their_age_and_each_other() -> None:
    ages, jobs = people_table()["ages"], people_table()["jobs"]["home"]
    for seed in range(80):
        cast = draw_cast(
            "Rs_int", ["kitchen_0", "bedroom_0", "bathroom_0"], np.random.default_rng(seed), "train", 0
        )
        mothers = [person for person in cast.people if "mother" in person.ties.values()]
        assert len(mothers) <= 1
        for person in cast.people:
            if person.job in ages:
                assert ages[person.job][0] <= person.age <= ages[person.job][1]
            if person.age >= 18:
                job = person.job if person.job in jobs else person.job.removeprefix("retired ")
                assert not is_held_out(job, 0, HELD_OUT_JOBS)
            if "mother" in person.ties.values():
                assert is_female(person.name)
                assert person.age > cast.people[0].age


def test_base_scenes_belong_to_kinds_of_places() -> None:
    found = {place_of(scene) for scene in Catalog.load().scene_ids}
    assert found == {"home", "restaurant", "office", "school", "shop", "hotel", "hall"}
