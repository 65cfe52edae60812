"""People, their day, and what they say to the robot: the same values whether a grammar or a language model made them."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field, model_validator

from embomatrix.world.task import TaskCategory

ROBOT = "robot"
"""Who answers the people."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Person(_Value):
    """One of the cast. ``ties`` says what this person is to others: {"Mia": "mother"}; ``rooms`` are where they are at home."""

    name: str = Field(min_length=1, max_length=40)
    age: int = Field(ge=3, le=110)
    job: str = Field(min_length=1, max_length=60)
    hobby: str = Field(min_length=1, max_length=60)
    rooms: tuple[str, ...] = ()
    ties: dict[str, str] = Field(default_factory=dict)


class DaySlot(_Value):
    """Something that a person does on this day, somewhere."""

    time: str = Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d$")
    person: str
    room: str
    activity: str = Field(min_length=3, max_length=120)


class Cast(_Value):
    """Who lives or works in a scene, and how their day goes."""

    setting: str = Field(min_length=1, max_length=120)
    people: tuple[Person, ...] = Field(min_length=2, max_length=5)
    day: tuple[DaySlot, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _known_people(self) -> Cast:
        names = [person.name for person in self.people]
        if len(set(names)) < len(names):
            raise ValueError(
                f"two people are called {max(names, key=names.count)!r}: every name must be unique"
            )
        for person in self.people:
            for other in person.ties:
                if other not in names or other == person.name:
                    raise ValueError(f"{person.name} is tied to {other!r}: expected another one of {names}")
        for slot in self.day:
            if slot.person not in names:
                raise ValueError(
                    f"{slot.person!r} has something to do at {slot.time}: expected one of {names}"
                )
        return self

    def of(self, name: str) -> Person:
        """Raises KeyError for a name that nobody has."""
        return {person.name: person for person in self.people}[name]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(person.name for person in self.people)

    def rooms_without_anyone(self, rooms: tuple[str, ...]) -> tuple[str, ...]:
        """Rooms that nobody is at home in or does anything in."""
        lived_in = {room for person in self.people for room in person.rooms} | {
            slot.room for slot in self.day
        }
        return tuple(room for room in rooms if room not in lived_in)


class Act(StrEnum):
    """What a turn of a conversation does."""

    NEED = "need"  # a person says what is the matter
    CLARIFY = "clarify"  # the robot asks which thing or which place
    ANSWER = "answer"  # the person says
    REFUSE = "refuse"  # the robot can't, and says why
    PROPOSE = "propose"  # the robot offers what it can do
    AMEND = "amend"  # somebody changes what was asked for
    ADD = "add"  # somebody asks for one thing more
    CONFIRM = "confirm"  # the robot says what it will do


class DialogueTurn(_Value):
    speaker: str
    act: Act
    text: str


class Conversation(_Value):
    """A dialogue about one request. ``first_wish`` and ``last_wishes`` tell how the request changed, clause by clause."""

    slot: DaySlot
    turns: tuple[DialogueTurn, ...] = Field(min_length=2)
    first_wish: str
    last_wishes: tuple[str, ...] = Field(min_length=1)

    @property
    def rounds(self) -> int:
        """How often the floor passed to a person."""
        return sum(
            turn.speaker != ROBOT and (number == 0 or self.turns[number - 1].speaker == ROBOT)
            for number, turn in enumerate(self.turns)
        )

    @property
    def changed(self) -> bool:
        """Whether what was asked for at last is not what was asked for first."""
        return self.last_wishes != (self.first_wish,)


class SceneBrief(_Value):
    """A base scene by its name."""

    scene: str
    seed: int = 0


class TalkBrief(_Value):
    """Who lives in a scene, and which kind of wish somebody is to come to."""

    scene: str
    cast: Cast
    category: TaskCategory = TaskCategory.PICK_AND_PLACE
    seed: int = 0


class SummaryBrief(_Value):
    """What was said."""

    scene: str
    cast: Cast
    conversation: Conversation
    seed: int = 0


class RequestSummary(_Value):
    """One instruction, and what it asks for: clauses of the conversation, or a model's wishes as JSON."""

    instruction: str
    wishes: tuple[str, ...]
