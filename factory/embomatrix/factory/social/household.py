"""People of a place: a seeded cast with jobs, hobbies and ties, from the table of people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.social.knowledge import people_table
from embomatrix.factory.social.values import Cast, DaySlot, Person

HELD_OUT_JOBS: Final = 5
"""One in this many jobs belongs to the held-out split."""
ADULT: Final = 18
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
    ties = people_table()["ties"]
    for _ in range(count - 1):
        people.append(
            _relative(first, ties, names, rng, split, seed)
            if place == "home"
            else _person(next(names), int(rng.integers(19, 64)), place, rng, split, seed)
        )
    slots = tuple(
        DaySlot(time="08:00", person=person.name, room=str(room), activity="starting the day")
        for person, room in zip(people, rng.permutation(list(rooms)), strict=False)
    )
    return Cast(setting=_SETTINGS[place], people=tuple(people), day=slots)


def _names(rng: np.random.Generator) -> Any:
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
        return Person(
            name=name,
            age=age,
            job="pupil",
            hobby=_drawn(table["children"]["hobbies"], rng),
            ties=dict(ties or {}),
        )
    jobs = [
        job for job in table["jobs"][place] if split == "heldout" or not is_held_out(job, seed, HELD_OUT_JOBS)
    ]
    kept = [job for job in jobs if is_held_out(job, seed, HELD_OUT_JOBS)]
    job = _drawn(kept if kept and rng.random() < 0.5 else jobs, rng)
    return Person(
        name=name, age=age, job=job, hobby=_drawn(table["hobbies"]["all"], rng), ties=dict(ties or {})
    )


def _relative(
    first: Person,
    ties: Sequence[Mapping[str, Any]],
    names: Any,
    rng: np.random.Generator,
    split: str,
    seed: int,
) -> Person:
    """Return a person with a tie to the first one that suits age and name."""
    name = next(names)
    while True:
        tie = ties[int(rng.integers(len(ties)))]
        low, high = tie["apart"]
        age = first.age + int(rng.integers(low, high + 1))
        fits = tie.get("female", False) is False or is_female(name)
        fits = fits and (not tie.get("male", False) or not is_female(name))
        if fits and 5 <= age <= 95:
            return _person(name, age, "home", rng, split, seed, {first.name: tie["tie"]})


def _drawn(options: Sequence[str], rng: np.random.Generator) -> str:
    return options[int(rng.integers(len(options)))]
