"""Social Simulation Agent, offline: a conversation in which a request takes shape over several rounds.

The wishes that it ends with are pieces of a goal that the scene allows. What comes before is made from them: a vague need with
its reason, a question, a first answer that is changed later, a chore that the robot has to refuse, a wish more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.social.fitting import themes_of
from embomatrix.factory.social.phrases import (
    AGREEMENTS,
    JOINS,
    MATTERS,
    QUESTIONS,
    TURNS,
    fill,
    shorten_repeated_rooms,
    spoken_category,
)
from embomatrix.factory.social.values import ROBOT, Act, Conversation, DialogueTurn
from embomatrix.factory.writer.goals import placed_elsewhere
from embomatrix.skills.limits import ROBOT as ROBOT_LIMITS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.factory.social.values import Cast, DaySlot
    from embomatrix.factory.writer.goals import GoalConjunct, GoalContext
    from embomatrix.factory.writer.words import Voice


REFUSED_SHARE: Final = 0.35
AMENDED_SHARE: Final = 0.7
PLACES_TRIED: Final = 5
INTERJECTED_SHARE: Final = 0.4
"""Of amendments, those that somebody else brings up who is at home in the same room."""


@dataclass(frozen=True, slots=True)
class ConversationScenario:
    """Who needs what, where, when, and why. ``pieces`` are the wishes that the conversation is to end with."""

    cast: Cast
    slot: DaySlot
    pieces: tuple[GoalConjunct, ...]
    why: str


class GrammarConversation:
    """One conversation, turn by turn."""

    def __init__(self, scenario: ConversationScenario, shop: GoalContext, voice: Voice) -> None:
        self._scenario = scenario
        self._shop = shop
        self._rng = shop.rng
        self._voice = voice
        self._turns: list[DialogueTurn] = []

    def run(self) -> Conversation:
        """Need, question, answer, changes, what the robot can't do and offers in its place, wishes more, confirmation."""
        slot, pieces = self._scenario.slot, self._scenario.pieces
        first, further = pieces[0], list(pieces[1:])
        self._open(first)
        earlier = self._earlier(first) if self._rng.random() < AMENDED_SHARE else None
        wished = self._settle(first, earlier)
        if self._rng.random() < REFUSED_SHARE:
            self._refuse(further)
        for piece in further:
            self._say(self._someone_near(), Act.ADD, clause=piece.clause)
        self._say(ROBOT, Act.CONFIRM, clauses=self._joined(pieces))
        return Conversation(
            slot=slot,
            turns=tuple(self._turns),
            first_wish=wished,
            last_wishes=tuple(piece.clause for piece in pieces),
        )

    def _open(self, first: GoalConjunct) -> None:
        sign = "place" if first.kind == "place" else first.signs[0].partition("(")[0]
        matters = MATTERS.get(f"{sign} {first.manner}", MATTERS[sign])
        matter = fill(self._voice.choose(matters), thing=first.thing)
        slot = self._scenario.slot
        self._say(slot.person, Act.NEED, activity=slot.activity, matter=matter, why=self._scenario.why)
        question = fill(self._voice.choose(QUESTIONS[first.kind]), thing=first.thing)
        self._say(ROBOT, Act.CLARIFY, question=question)

    def _earlier(self, first: GoalConjunct) -> GoalConjunct | None:
        """Another place for the same thing, where a person would put it too."""
        for _ in range(PLACES_TRIED):
            other = placed_elsewhere(self._shop, first)
            if other is not None and themes_of(other, self._shop.view):
                return other
        return None

    def _refuse(self, further: list[GoalConjunct]) -> None:
        """Somebody asks for what the robot can't do; it offers the next wish, which is then no longer among the ``further``."""
        slot = self._scenario.slot
        chore, reason = impossible_request(self._shop.view, slot.room, self._rng)
        self._say(slot.person, Act.ADD, clause=chore)
        self._say(ROBOT, Act.REFUSE, chore=chore, reason=reason)
        if further:
            self._say(ROBOT, Act.PROPOSE, clause=further.pop(0).clause)
            self._turns.append(
                DialogueTurn(speaker=slot.person, act=Act.ANSWER, text=self._voice.choose(AGREEMENTS))
            )

    def _settle(self, first: GoalConjunct, earlier: GoalConjunct | None) -> str:
        """The first wish is agreed on, at once or after a change; returns what was wished at first."""
        person = self._scenario.slot.person
        if earlier is None:
            self._say(person, Act.ANSWER, clause=first.clause)
            return first.clause
        self._say(person, Act.ANSWER, clause=earlier.clause)
        self._say(ROBOT, Act.CONFIRM, clauses=earlier.clause)
        changer = self._someone_near() if self._rng.random() < INTERJECTED_SHARE else person
        self._say(changer, Act.AMEND, clause=first.clause)
        return earlier.clause

    def _someone_near(self) -> str:
        """The person, or another one who is at home in this room: who hears what is said here."""
        slot, cast = self._scenario.slot, self._scenario.cast
        near = [
            person.name for person in cast.people if slot.room in person.rooms and person.name != slot.person
        ]
        return near[int(self._rng.integers(len(near)))] if near and self._rng.random() < 0.5 else slot.person

    def _joined(self, pieces: Sequence[GoalConjunct]) -> str:
        text = pieces[0].clause
        for piece in pieces[1:]:
            text += self._voice.choose(JOINS) + piece.clause
        return text

    def _say(self, speaker: str, act: Act, **words: str) -> None:
        text = shorten_repeated_rooms(fill(self._voice.choose(TURNS[act]), **words), self._shop.view)
        self._turns.append(DialogueTurn(speaker=speaker, act=act, text=text))


def starting_slots(cast: Cast, rooms: Sequence[str], rng: np.random.Generator) -> list[DaySlot]:
    """The day's slots in random order, those in the given rooms first."""
    order = [cast.day[int(at)] for at in rng.permutation(len(cast.day))]
    return sorted(order, key=lambda slot: slot.room not in rooms)


_ANYWHERE: Final = (
    ("vacuum the floor", "I have one arm with a gripper, and no vacuum cleaner"),
    ("answer the door and sign for the parcel", "I don't write"),
    ("take the bags upstairs", "stairs are not for my wheels"),
    ("change the light bulb", "my gripper can't screw one in"),
)
_BY_ROOM: Final[Mapping[str, tuple[tuple[str, str], ...]]] = {
    "kitchen": (
        ("peel the potatoes", "peeling takes two hands, and I have one"),
        ("taste whether it is salty enough", "I can't taste"),
    ),
    "bathroom": (("unblock the drain", "I don't reach into pipes"),),
    "bedroom": (("make the bed", "sheets slip out of my gripper"),),
    "garden": (("mow the lawn", "I stay on the paths"),),
    "classroom": (("wipe the board", "I don't wipe"),),
    "private_office": (("call them back", "I don't use the telephone"),),
}
HEAVY_LOADS: Final = 2.0
"""So many times the arm's load: nobody doubts that it is too heavy."""


def impossible_request(view: SceneView, room: str, rng: np.random.Generator) -> tuple[str, str]:
    """A chore and why the robot can't do it; furniture of the room counts, if it is too heavy."""
    types = {item.name: item.type for item in view.scene.rooms}
    options = [*_ANYWHERE, *_BY_ROOM.get(types.get(room, ""), ())]
    options += [
        (
            f"push the {spoken_category(view.category(name))} to the other wall",
            f"it weighs more than the {ROBOT_LIMITS.mass_kg:g} kg that my arm lifts",
        )
        for name in view.in_room.get(room, ())
        if view.asset(name).mass_kg > HEAVY_LOADS * ROBOT_LIMITS.mass_kg and len(view.alike(name)) == 1
    ]
    return options[int(rng.integers(len(options)))]
