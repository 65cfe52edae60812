"""People, schedule and conversation. Rules and language models produce the same values."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field, model_validator

from embomatrix.world.task import TaskCategory

ROBOT = "robot"
"""Speaker name of the robot."""


class StrictModel(BaseModel):
    """Frozen value that rejects unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Person(StrictModel):
    """Member of a cast.

    ``ties`` maps other people to this person's relation to them: {"Mia": "mother"}. ``rooms`` are their own rooms.
    """

    name: str = Field(min_length=1, max_length=40)
    age: int = Field(ge=3, le=110)
    job: str = Field(min_length=1, max_length=60)
    hobby: str = Field(min_length=1, max_length=60)
    rooms: tuple[str, ...] = ()
    ties: dict[str, str] = Field(default_factory=dict)


class DaySlot(StrictModel):
    """Activity of a cast member at a time and place."""

    time: str = Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d$")
    person: str
    room: str
    activity: str = Field(min_length=3, max_length=120)


class Cast(StrictModel):
    """People of a scene, and their schedule."""

    setting: str = Field(min_length=1, max_length=120)
    people: tuple[Person, ...] = Field(min_length=2, max_length=5)
    day: tuple[DaySlot, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _known_people(self) -> Cast:
        names = [person.name for person in self.people]
        if len(set(names)) < len(names):
            raise ValueError(
                f"two people have the name {max(names, key=names.count)!r}: every name must be unique"
            )
        for person in self.people:
            for other in person.ties:
                if other not in names or other == person.name:
                    raise ValueError(
                        f"{person.name} has a tie to {other!r}: expected another person of {names}"
                    )
        for slot in self.day:
            if slot.person not in names:
                raise ValueError(f"the slot at {slot.time} names {slot.person!r}: expected one of {names}")
        return self

    def of(self, name: str) -> Person:
        """Return the person with this name. Raise KeyError."""
        return {person.name: person for person in self.people}[name]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(person.name for person in self.people)

    @property
    def rooms(self) -> frozenset[str]:
        """Rooms with an owner or a visitor."""
        own = (room for person in self.people for room in person.rooms)
        return frozenset((*own, *(slot.room for slot in self.day)))


class Act(StrEnum):
    """Speech act of a turn."""

    NEED = "need"  # a cast member states a need
    CLARIFY = "clarify"  # the robot asks for the object or place
    ANSWER = "answer"  # the cast member answers
    REFUSE = "refuse"  # the robot refuses and says why
    PROPOSE = "propose"  # the robot proposes something that it can do
    AMEND = "amend"  # a cast member changes the request
    ADD = "add"  # a cast member adds a request
    CONFIRM = "confirm"  # the robot confirms the request
    THANKS = "thanks"  # the cast member has nothing to add


class DialogueTurn(StrictModel):
    speaker: str
    act: Act
    text: str


class Conversation(StrictModel):
    """Dialogue about one request. ``first_wish`` and ``last_wishes`` show its change, clause by clause."""

    slot: DaySlot
    turns: tuple[DialogueTurn, ...] = Field(min_length=2)
    first_wish: str
    last_wishes: tuple[str, ...] = Field(min_length=1)


class SceneBrief(StrictModel):
    """Brief with the name of a base scene."""

    scene: str
    seed: int = 0


class TalkBrief(StrictModel):
    """Brief of a conversation: cast, and category of the request."""

    scene: str
    cast: Cast
    category: TaskCategory = TaskCategory.PICK_AND_PLACE
    seed: int = 0


class SummaryBrief(StrictModel):
    """Brief of a summary: cast and conversation."""

    scene: str
    cast: Cast
    conversation: Conversation
    seed: int = 0


class RequestSummary(StrictModel):
    """Instruction with its requested atoms, as clauses of the conversation or as JSON of a model."""

    instruction: str
    wishes: tuple[str, ...]
