"""Activities by room type: hour, people, reasons for needing help, and themes of suitable requests.

The table is ``occasions.toml`` beside this module.
"""

import functools
import tomllib
from collections.abc import Mapping
from enum import StrEnum
from importlib import resources
from typing import Final

from pydantic import Field, TypeAdapter

from embomatrix.factory.social.values import Person, StrictModel


class Theme(StrEnum):
    """Theme of an activity and of a request."""

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
"""Key of the table for room types without an entry."""
SERVED: Final = frozenset({"guest", "regular guest", "customer", "visitor", "speaker", "pupil"})
"""Jobs of people who are guests of a place. They do no staff activities."""


class Occasion(StrictModel):
    """Activity, as a phrase that follows "is". ``why`` lists clauses with a reason for needing help.

    ``ages`` limits the people; ``staff`` excludes guests.
    """

    hour: int = Field(ge=0, le=23)
    doing: str = Field(min_length=3)
    themes: frozenset[Theme] = Field(min_length=1)
    why: tuple[str, ...] = Field(min_length=1)
    ages: tuple[int, int] = (3, 110)
    staff: bool = False
    private: bool = False
    """True if people do it only at home."""

    def suits(self, person: Person) -> bool:
        """True if the person may do this."""
        return self.ages[0] <= person.age <= self.ages[1] and not (self.staff and person.job in SERVED)


@functools.cache
def occasions() -> Mapping[str, tuple[Occasion, ...]]:
    """Return the table by room type."""
    text = (resources.files("embomatrix.factory.social") / FILE).read_text(encoding="utf-8")
    return TypeAdapter(dict[str, tuple[Occasion, ...]]).validate_python(tomllib.loads(text))


def occasions_in(room_type: str) -> tuple[Occasion, ...]:
    """Return the activities of a room type."""
    return occasions().get(room_type, occasions()[ELSEWHERE])


@functools.cache
def _by_phrase() -> Mapping[str, Occasion]:
    return {occasion.doing: occasion for found in occasions().values() for occasion in found}


def occasion_of(activity: str) -> Occasion | None:
    """Return the activity of a rule-based slot; None for an invented activity."""
    return _by_phrase().get(activity)
