"""Rule-based Social Simulation Agent: a conversation in which a request takes shape over several rounds.

The final requests are conjuncts of a feasible goal. The conversation is derived from them: a vague need with its
reason, a question, an answer that may change, a request that the robot refuses, and further requests.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.fitting import themes_of
from embomatrix.factory.social.phrases import (
    AGREEMENTS,
    NEEDS,
    QUESTIONS,
    TURNS,
    fill,
    joined,
    shorten_repeated_rooms,
    spoken_category,
)
from embomatrix.factory.social.values import ROBOT, Act, Cast, Conversation, DaySlot, DialogueTurn
from embomatrix.factory.writer.goals import GoalConjunct, GoalContext, placed_elsewhere
from embomatrix.factory.writer.words import Voice
from embomatrix.skills.limits import ROBOT as ROBOT_LIMITS

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
"""Multiple of the arm's load from which on an object is obviously too heavy."""


def impossible_request(view: SceneView, room: str, rng: np.random.Generator) -> tuple[str, str]:
    """Return a request and the reason why the robot can't fulfil it. Heavy furniture of the room is a candidate."""
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


REFUSED_SHARE: Final = 0.35
AMENDED_SHARE: Final = 0.7
PLACES_TRIED: Final = 5
INTERJECTED_SHARE: Final = 0.4
"""Share of the changes that another cast member in the same room proposes."""


@dataclass(frozen=True, slots=True)
class ConversationScenario:
    """Person, time, place and reason of a need. ``conjuncts`` are the final requests of the conversation."""

    cast: Cast
    slot: DaySlot
    conjuncts: tuple[GoalConjunct, ...]
    why: str


class GrammarConversation:
    """Generator of one conversation, turn by turn."""

    def __init__(self, scenario: ConversationScenario, context: GoalContext, voice: Voice) -> None:
        self._scenario = scenario
        self._context = context
        self._rng = context.rng
        self._voice = voice
        self._turns: list[DialogueTurn] = []

    def run(self) -> Conversation:
        """Return the conversation: need, question, answer, changes, refusal with a proposal, further requests, confirmation."""
        slot, conjuncts = self._scenario.slot, self._scenario.conjuncts
        first, further = conjuncts[0], list(conjuncts[1:])
        self._open(first)
        earlier = self._alternative_place(first) if self._rng.random() < AMENDED_SHARE else None
        wished = self._settle(first, earlier)
        if self._rng.random() < REFUSED_SHARE:
            self._refuse(further)
        for conjunct in further:
            self._say(self._person_nearby(), Act.ADD, clause=conjunct.clause)
        self._say(ROBOT, Act.CONFIRM, clauses=joined([each.clause for each in conjuncts], self._voice))
        return Conversation(
            slot=slot,
            turns=tuple(self._turns),
            first_wish=wished,
            last_wishes=tuple(conjunct.clause for conjunct in conjuncts),
        )

    def _open(self, first: GoalConjunct) -> None:
        sign = "place" if first.kind == "place" else first.signs[0].partition("(")[0]
        matters = NEEDS.get(f"{sign} {first.manner}", NEEDS[sign])
        matter = fill(self._voice.choose(matters), thing=first.thing)
        slot = self._scenario.slot
        self._say(slot.person, Act.NEED, activity=slot.activity, matter=matter, why=self._scenario.why)
        question = fill(self._voice.choose(QUESTIONS[first.kind]), thing=first.thing)
        self._say(ROBOT, Act.CLARIFY, question=question)

    def _alternative_place(self, first: GoalConjunct) -> GoalConjunct | None:
        """Return another plausible place for the same object, or None."""
        for _ in range(PLACES_TRIED):
            other = placed_elsewhere(self._context, first)
            if other is not None and themes_of(other, self._context.view):
                return other
        return None

    def _refuse(self, further: list[GoalConjunct]) -> None:
        """Add a request that the robot refuses. It then proposes the next request, which leaves ``further``."""
        slot = self._scenario.slot
        request, reason = impossible_request(self._context.view, slot.room, self._rng)
        self._say(slot.person, Act.ADD, clause=request)
        self._say(ROBOT, Act.REFUSE, chore=request, reason=reason)
        if further:
            self._say(ROBOT, Act.PROPOSE, clause=further.pop(0).clause)
            self._turns.append(
                DialogueTurn(speaker=slot.person, act=Act.ANSWER, text=self._voice.choose(AGREEMENTS))
            )

    def _settle(self, first: GoalConjunct, earlier: GoalConjunct | None) -> str:
        """Agree on the first request, directly or after a change, and return the initial one."""
        person = self._scenario.slot.person
        if earlier is None:
            self._say(person, Act.ANSWER, clause=first.clause)
            return first.clause
        self._say(person, Act.ANSWER, clause=earlier.clause)
        self._say(ROBOT, Act.CONFIRM, clauses=earlier.clause)
        changer = self._person_nearby() if self._rng.random() < INTERJECTED_SHARE else person
        self._say(changer, Act.AMEND, clause=first.clause)
        return earlier.clause

    def _person_nearby(self) -> str:
        """Return the person of the slot, or another person who belongs to the room and hears the conversation."""
        slot, cast = self._scenario.slot, self._scenario.cast
        near = [
            person.name for person in cast.people if slot.room in person.rooms and person.name != slot.person
        ]
        return near[int(self._rng.integers(len(near)))] if near and self._rng.random() < 0.5 else slot.person

    def _say(self, speaker: str, act: Act, **words: str) -> None:
        text = shorten_repeated_rooms(fill(self._voice.choose(TURNS[act]), **words), self._context.view)
        self._turns.append(DialogueTurn(speaker=speaker, act=act, text=text))


def starting_slots(cast: Cast, rooms: Sequence[str], rng: np.random.Generator) -> list[DaySlot]:
    """Return the day's slots in random order, those in the given rooms first."""
    order = [cast.day[int(at)] for at in rng.permutation(len(cast.day))]
    return sorted(order, key=lambda slot: slot.room not in rooms)
