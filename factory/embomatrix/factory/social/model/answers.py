"""Answers of the language-model agents: people, the events of a day, a turn of a dialogue, requests, and demands."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from embomatrix.factory.social.rules.demands import Demands
from embomatrix.factory.social.values import ROBOT, Cast, DaySlot, Person, StrictModel
from embomatrix.factory.social.wish import Wish

PlainText = Annotated[str, Field(min_length=2, max_length=300, pattern=r"^[^\n<>{}]*$")]
"""Text without markup, which could end a section of a later prompt."""
MAX_REQUESTS = 4
"""Maximum number of requests in one dialogue."""
MAX_NEEDS = 3
"""Maximum number of needs of the person to whom an event happens."""


class RoomSighting(StrictModel):
    """Description of each room by a vision model."""

    rooms: dict[str, Annotated[str, Field(min_length=10, max_length=300, pattern=r"^[^\n<>]*$")]]


class PersonAnswer(StrictModel):
    """Person with habits, which only this person knows."""

    name: str = Field(pattern=r"^[A-Z][a-zé]{1,20}$")
    age: int = Field(ge=3, le=110)
    job: PlainText
    hobby: PlainText
    rooms: tuple[str, ...] = ()
    ties: dict[str, str] = Field(default_factory=dict)
    """Relation of each of the others to this person, such as ``mother``."""
    habits: tuple[PlainText, ...] = Field((), max_length=3)

    def person(self, ties: Mapping[str, str]) -> Person:
        """Return the person without the habits. ``ties`` are what this person is to the others."""
        return Person(**self.model_dump(exclude={"habits", "ties"}), ties=dict(ties))


class PeopleAnswer(StrictModel):
    """People of a scene."""

    setting: PlainText
    people: tuple[PersonAnswer, ...] = Field(min_length=2, max_length=5)


class EventAnswer(StrictModel):
    """Event of a day that causes needs. ``other`` is a second person who is there, with an own need."""

    time: str = Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d$")
    person: str
    room: str
    activity: PlainText
    needs: tuple[PlainText, ...] = Field(min_length=1, max_length=MAX_NEEDS)
    other: str = ""
    other_need: str = Field("", max_length=300, pattern=r"^[^\n<>{}]*$")

    def slot(self) -> DaySlot:
        """Return time, person, room and activity."""
        return DaySlot(time=self.time, person=self.person, room=self.room, activity=self.activity[:120])


class DayAnswer(StrictModel):
    """Events of one day."""

    events: tuple[EventAnswer, ...] = Field(min_length=2, max_length=8)


class PersonTurn(StrictModel):
    """Turn of a person."""

    act: Literal["need", "answer", "amend", "add", "thanks"]
    text: PlainText


class RobotTurn(StrictModel):
    """Turn of the robot."""

    act: Literal["clarify", "refuse", "propose", "confirm"]
    text: PlainText


class RequestAnswer(StrictModel):
    """Instruction and the wish that it states."""

    instruction: str = Field(max_length=1000)
    wish: Wish


class SummaryAnswer(StrictModel):
    """Requests that a dialogue led to, each of which can be carried out alone."""

    requests: tuple[RequestAnswer, ...] = Field(min_length=1, max_length=MAX_REQUESTS)


class ReadingAnswer(StrictModel):
    """Demands of several instructions, in their order."""

    answers: tuple[Demands, ...] = Field(min_length=1, max_length=MAX_REQUESTS)


@dataclass(frozen=True, slots=True)
class Household:
    """People of a scene, with the habits that each of them alone knows."""

    setting: str
    people: tuple[Person, ...]
    habits: Mapping[str, tuple[str, ...]]

    @staticmethod
    def of(answer: PeopleAnswer) -> "Household":
        """Return the household of an answer. Raise ValueError for a tie to a stranger or for equal names."""
        names = [person.name for person in answer.people]
        for person in answer.people:
            strangers = sorted(set(person.ties) - (set(names) - {person.name}))
            if strangers:
                raise ValueError(
                    f"{person.name} has a tie to {strangers[0]!r}: expected another person of {names}"
                )
        if len(set(names)) < len(names) or any(name.lower() == ROBOT for name in names):
            raise ValueError(f"names must be unique and not {ROBOT!r}, found {', '.join(names)}")
        told = {each.name: each.ties for each in answer.people}
        people = tuple(
            each.person(ties={other: told[other][each.name] for other in told if each.name in told[other]})
            for each in answer.people
        )
        return Household(answer.setting, people, {each.name: each.habits for each in answer.people})

    def person(self, name: str) -> Person:
        """Return the person with this name. Raise KeyError."""
        return {person.name: person for person in self.people}[name]

    def cast(self, day: tuple[DaySlot, ...]) -> Cast:
        """Return the people with the schedule of a day."""
        return Cast(setting=self.setting[:120], people=self.people, day=day)
