"""People of a place: a seeded cast with jobs, hobbies and ties, from the table of people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.social.knowledge import people_table
from embomatrix.factory.social.values import Cast, DaySlot, Person

HELD_OUT_JOBS: Final = 5
"""One in this many jobs belongs to the held-out split."""
ADULT: Final = 18
RETIRED: Final = 68
_PLACES: Final = ("restaurant", "office", "school", "hotel", "hall")
_SETTINGS: Final = {
    "home": "the people of a home",
    "restaurant": "the staff of a restaurant",
    "office": "the staff of an office",
    "school": "the people of a school",
    "shop": "the staff of a shop",
    "hotel": "the people of a hotel",
    "hall": "the staff of a hall",
}


def place_of(base: str) -> str:
    """Return the kind of place of a base scene: home, restaurant, office, school, shop, hotel or hall."""
    if base.startswith("grocery_store"):
        return "shop"
    return next((place for place in _PLACES if base.startswith(place)), "home")


def is_female(name: str) -> bool:
    """True for a name of the list of women's names."""
    return name in people_table()["names"]["female"]


def draw_cast(base: str, rooms: Sequence[str], rng: np.random.Generator, split: str, seed: int) -> Cast:
    """Return the people of a place. Equal generator states give equal casts."""
    place = place_of(base)
    names = _names(rng)
    count = int(rng.integers(2, 5))
    first = _person(next(names), int(rng.integers(24, 72)), place, rng, split, seed)
    people = [first]
    for _ in range(count - 1):
        name = next(names)
        if place == "home":
            known = {tie for person in people for tie in person.ties.values()}
            taken = frozenset(tie["group"] for tie in people_table()["ties"] if tie["tie"] in known)
            people.append(_relative(first, taken, name, rng, split, seed))
        else:
            people.append(_person(name, int(rng.integers(19, 64)), place, rng, split, seed))
    slots = tuple(
        DaySlot(time="08:00", person=person.name, room=str(room), activity="starting the day")
        for person, room in zip(people, rng.permutation(list(rooms)), strict=False)
    )
    return Cast(setting=_SETTINGS[place], people=tuple(people), day=slots)


def _names(rng: np.random.Generator) -> Iterator[str]:
    table = people_table()["names"]
    return iter([str(name) for name in rng.permutation([*table["female"], *table["male"]])])


def _person(
    name: str,
    age: int,
    place: str,
    rng: np.random.Generator,
    split: str,
    seed: int,
    ties: Mapping[str, str] | None = None,
) -> Person:
    table = people_table()
    if age < ADULT:
        hobby = _drawn(table["children"]["hobbies"], rng)
        return Person(name=name, age=age, job="pupil", hobby=hobby, ties=dict(ties or {}))
    ages = table["ages"]
    fitting = [job for job in table["jobs"][place] if job not in ages or ages[job][0] <= age <= ages[job][1]]
    kept = [job for job in fitting if is_held_out(job, seed, HELD_OUT_JOBS)]
    known = [job for job in fitting if job not in kept]
    job = _drawn(kept if kept and split == "heldout" and rng.random() < 0.5 else known, rng)
    if age >= RETIRED and not job.startswith("retired"):
        job = f"retired {job}"
    return Person(
        name=name, age=age, job=job, hobby=_drawn(table["hobbies"]["all"], rng), ties=dict(ties or {})
    )


def _relative(
    first: Person, taken: frozenset[str], name: str, rng: np.random.Generator, split: str, seed: int
) -> Person:
    """Return a person with a tie to the first one that suits age and name, and that nobody else has unless it may repeat."""
    while True:
        ties = people_table()["ties"]
        tie = ties[int(rng.integers(len(ties)))]
        low, high = tie["apart"]
        age = first.age + int(rng.integers(low, high + 1))
        fits = not (tie.get("female") and not is_female(name)) and not (tie.get("male") and is_female(name))
        if fits and 5 <= age <= 95 and (tie.get("repeats") or tie["group"] not in taken):
            return _person(name, age, "home", rng, split, seed, {first.name: tie["tie"]})


def _drawn(options: Sequence[str], rng: np.random.Generator) -> str:
    return options[int(rng.integers(len(options)))]
