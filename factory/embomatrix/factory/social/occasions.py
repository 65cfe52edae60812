"""What people do in which room at which hour, who does it, why they want help, and which wishes go with it.

The table is ``occasions.toml`` beside this module.
"""

from __future__ import annotations

import functools
import tomllib
from enum import StrEnum
from importlib import resources
from typing import TYPE_CHECKING, Final

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.factory.social.values import Person


class Theme(StrEnum):
    """What an activity is about, and what a wish can be for."""

    COOKING = "cooking"
    MEALS = "meals"
    GUESTS = "guests"
    SCREENS = "screens"
    READING = "reading"
    PAPERS = "papers"
    PLAY = "play"
    SLEEP = "sleep"
    WASHING = "washing"
    LAUNDRY = "laundry"
    TIDYING = "tidying"
    LEAVING = "leaving"
    STOCK = "stock"
    TEACHING = "teaching"


FILE: Final = "occasions.toml"
ELSEWHERE: Final = "elsewhere"
"""Stands in the table for types of rooms that are not in it."""
SERVED: Final = frozenset({"guest", "regular guest", "customer", "visitor", "speaker", "pupil"})
"""Jobs of those who are served in a place: they don't do what the house does."""


class Occasion(BaseModel):
    """An activity, as a phrase that follows "is". ``why`` are clauses that tell why help is wanted.

    Somebody of such an age does it, and where it is ``staff``, nobody who is only served there.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    hour: int = Field(ge=0, le=23)
    doing: str = Field(min_length=3)
    themes: frozenset[Theme] = Field(min_length=1)
    why: tuple[str, ...] = Field(min_length=1)
    ages: tuple[int, int] = (3, 110)
    staff: bool = False
    private: bool = False
    """Whether it is done only where people live."""

    def suits(self, person: Person) -> bool:
        """Whether such a person does this."""
        return self.ages[0] <= person.age <= self.ages[1] and not (self.staff and person.job in SERVED)


@functools.cache
def occasions() -> Mapping[str, tuple[Occasion, ...]]:
    """The whole table, by type of room."""
    text = (resources.files("embomatrix.factory.social") / FILE).read_text(encoding="utf-8")
    return TypeAdapter(dict[str, tuple[Occasion, ...]]).validate_python(tomllib.loads(text))


def occasions_in(room_type: str) -> tuple[Occasion, ...]:
    """For rooms of any type."""
    return occasions().get(room_type, occasions()[ELSEWHERE])


@functools.cache
def _by_phrase() -> Mapping[str, Occasion]:
    return {occasion.doing: occasion for found in occasions().values() for occasion in found}


def occasion_of(activity: str) -> Occasion | None:
    """The occasion that a slot of a day tells of; None where somebody else than the grammar made it up."""
    return _by_phrase().get(activity)
