"""Agents on a language model: people, day, one turn of one speaker, requests of a dialogue, and demands of instructions.

Each agent requests a typed answer and checks it. Problems are returned to the model as a sentence. Descriptions of the
scene are marked as data, so that instructions in names are ignored.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from pydantic import BaseModel

from embomatrix.factory.language.nouns import everyday_noun
from embomatrix.factory.social.knowledge import events
from embomatrix.factory.social.model.answers import (
    DayAnswer,
    EventAnswer,
    Household,
    PeopleAnswer,
    PersonTurn,
    ReadingAnswer,
    RobotTurn,
    RoomSighting,
    SummaryAnswer,
)
from embomatrix.factory.social.model.prompts import (
    DAY_SYSTEM,
    DAY_USER,
    EARLIER,
    LAST_TURN,
    NO_TALK,
    PEOPLE_SYSTEM,
    PEOPLE_USER,
    PERSON_SYSTEM,
    READING_SYSTEM,
    READING_USER,
    REPAIR,
    ROBOT_SYSTEM,
    SIGHT_SYSTEM,
    SIGHT_USER,
    SUMMARY_SYSTEM,
    SUMMARY_USER,
    TURN_USER,
)
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import ROBOT, Act, DialogueTurn
from embomatrix.llm.structured import ask
from embomatrix.llm.values import ChatModel, ChatRequest, Message, Speaker

SIGHT: Final = "scene information extraction"
PEOPLE: Final = "role-playing agent"
DAY: Final = "day planner"
TURN: Final = "dialogue turn"
SUMMARY: Final = "summarization agent"
READING: Final = "validation agent"
"""Purposes of the requests, for ledgers and errors."""
INVENTION: Final = 0.9
"""Sampling temperature of invented content."""
CARE: Final = 0.2
"""Sampling temperature of summaries and readings."""
TURN_TOKENS: Final = 160
"""Maximum number of tokens in a turn."""
ATTEMPTS: Final = 2
"""Answers requested for one question."""
LISTED_EARLIER: Final = 24
"""Number of earlier instructions that the day planner sees."""

T = TypeVar("T", bound=BaseModel)


class SocialModelAgents:
    """Social agents on one model. ``max_tokens`` limits an answer."""

    def __init__(self, model: ChatModel, *, max_tokens: int = 2048) -> None:
        self._model = model
        self._max_tokens = max_tokens

    async def describe(self, scene: SceneKinds, pictures: tuple[bytes, ...], seed: int) -> RoomSighting:
        """Describe the rooms from pictures in PNG format. Raise LlmError."""
        rooms = list(scene.rooms)

        def check(sight: RoomSighting) -> None:
            if unknown := sorted(set(sight.rooms) - set(rooms)):
                raise ValueError(f"there is no room {unknown[0]!r}: the rooms are {', '.join(rooms)}")
            if missing := [room for room in rooms if room not in sight.rooms]:
                raise ValueError(f"no sentence describes {', '.join(missing)}: give each room a sentence")

        user = Message(Speaker.USER, SIGHT_USER.format(scene=scene.listed()), pictures)
        request = ChatRequest(
            SIGHT, (Message(Speaker.SYSTEM, SIGHT_SYSTEM), user), self._max_tokens, CARE, seed
        )
        return await ask(self._model, request, RoomSighting, check=check)

    async def people(self, scene: SceneKinds, seed: int) -> Household:
        """Invent people who suit the scene. Raise LlmError."""

        def check(answer: PeopleAnswer) -> None:
            Household.of(answer)
            rooms = {room for person in answer.people for room in person.rooms}
            if unknown := sorted(rooms - set(scene.rooms)):
                raise ValueError(f"there is no room {unknown[0]!r}: the rooms are {', '.join(scene.rooms)}")

        user = PEOPLE_USER.format(scene=scene.listed())
        return Household.of(await self._ask(PEOPLE, PEOPLE_SYSTEM, user, seed, PeopleAnswer, check))

    async def plan_day(
        self, scene: SceneKinds, household: Household, earlier: Sequence[str], seed: int
    ) -> tuple[EventAnswer, ...]:
        """Invent the events of a day, different from the earlier instructions. Raise LlmError."""
        names = {person.name for person in household.people}

        def check(day: DayAnswer) -> None:
            for event in day.events:
                if event.person not in names or event.other not in {"", *names} - {event.person}:
                    raise ValueError(
                        f"the event at {event.time}: expected two people of {', '.join(sorted(names))}"
                    )
                if event.room not in scene.rooms:
                    raise ValueError(
                        f"there is no room {event.room!r}: the rooms are {', '.join(scene.rooms)}"
                    )

        people = "\n".join(
            f"{each.name}, {each.age}, {each.job}, likes {each.hobby}; {'; '.join(household.habits[each.name])}"
            for each in household.people
        )
        told = "\n".join(f"- {line}" for line in earlier[-LISTED_EARLIER:])
        before = EARLIER.format(lines=told) if told else ""
        system = DAY_SYSTEM.format(things=_small_things())
        user = DAY_USER.format(scene=scene.listed(), people=people, earlier=before)
        return (await self._ask(DAY, system, user, seed, DayAnswer, check)).events

    async def person_turn(
        self,
        scene: SceneKinds,
        household: Household,
        event: EventAnswer,
        name: str,
        turns: Sequence[DialogueTurn],
        seed: int,
    ) -> DialogueTurn:
        """Return the next turn of a person, who knows the own needs, habits and rooms. Raise LlmError."""
        person = household.person(name)
        needs = event.needs if name == event.person else (event.other_need,)
        others = [each for each in (event.person, event.other) if each not in ("", name)]
        ties = "".join(f"You are {other}'s {tie}. " for other, tie in person.ties.items())
        system = PERSON_SYSTEM.format(
            name=name,
            age=person.age,
            job=person.job,
            hobby=person.hobby,
            ties=ties,
            habits="".join(f"Habit: {_unended(habit)}. " for habit in household.habits[name]),
            time=event.time,
            room=event.room.replace("_", " "),
            activity=_unended(
                event.activity if name == event.person else f"{event.person} is {event.activity}"
            ),
            others=" and ".join((*others, "the robot")),
            needs=" ".join(f"{_unended(need)}." for need in needs),
            rooms=scene.within((event.room, *person.rooms)).told(),
        )
        answer = await self._speak(system, turns, seed, PersonTurn)
        return DialogueTurn(speaker=name, act=Act(answer.act), text=answer.text)

    async def robot_turn(
        self,
        scene: SceneKinds,
        event: EventAnswer,
        turns: Sequence[DialogueTurn],
        seed: int,
        *,
        is_last: bool,
    ) -> DialogueTurn:
        """Return the next turn of the robot, which knows its skills, who is there, and the furniture. Raise LlmError."""
        system = ROBOT_SYSTEM.format(
            place=event.room.replace("_", " "),
            people=" and ".join(filter(None, (event.person, event.other))),
            scene=scene.told(),
            last=LAST_TURN if is_last else "",
        ).rstrip()
        answer = await self._speak(system, turns, seed, RobotTurn)
        return DialogueTurn(speaker=ROBOT, act=Act(answer.act), text=answer.text)

    async def summarise(self, scene: SceneKinds, turns: Sequence[DialogueTurn], seed: int) -> SummaryAnswer:
        """Summarise a dialogue as requests. Raise LlmError."""
        return await ask(self._model, self._summary(scene, turns, seed), SummaryAnswer, attempts=ATTEMPTS)

    async def repair(
        self,
        scene: SceneKinds,
        turns: Sequence[DialogueTurn],
        answer: SummaryAnswer,
        problems: Sequence[str],
        seed: int,
    ) -> SummaryAnswer:
        """Summarise again, given an answer and a sentence for each of its requests that can't be used. Raise LlmError."""
        request = self._summary(scene, turns, seed)
        listed = "\n".join(problems)
        objection = (
            Message(Speaker.ASSISTANT, answer.model_dump_json(exclude_defaults=True)),
            Message(Speaker.USER, REPAIR.format(problems=listed)),
        )
        request = ChatRequest(
            SUMMARY, (*request.messages, *objection), request.max_tokens, request.temperature, seed
        )

        def check(found: SummaryAnswer) -> None:
            if len(found.requests) != len(problems):
                raise ValueError(f"expected {len(problems)} requests, found {len(found.requests)}")

        return await ask(self._model, request, SummaryAnswer, check=check, attempts=ATTEMPTS)

    async def demands(self, scene: SceneKinds, instructions: Sequence[str], seed: int) -> ReadingAnswer:
        """State what each instruction demands. The agent sees no wish. Raise LlmError."""

        def check(found: ReadingAnswer) -> None:
            if len(found.answers) != len(instructions):
                raise ValueError(f"expected {len(instructions)} answers, found {len(found.answers)}")

        listed = "\n".join(f"{number}. {line}" for number, line in enumerate(instructions, start=1))
        user = READING_USER.format(scene=scene.told(), instructions=listed)
        request = self._request(READING, READING_SYSTEM, user, seed, CARE)
        return await ask(self._model, request, ReadingAnswer, check=check, attempts=ATTEMPTS)

    def _summary(self, scene: SceneKinds, turns: Sequence[DialogueTurn], seed: int) -> ChatRequest:
        user = SUMMARY_USER.format(scene=scene.listed(), talk=talk_of(turns))
        return self._request(SUMMARY, SUMMARY_SYSTEM, user, seed, CARE)

    async def _speak(self, system: str, turns: Sequence[DialogueTurn], seed: int, shape: type[T]) -> T:
        user = TURN_USER.format(talk=talk_of(turns) or NO_TALK)
        messages = (Message(Speaker.SYSTEM, system), Message(Speaker.USER, user))
        tokens = min(TURN_TOKENS, self._max_tokens)
        request = ChatRequest(TURN, messages, tokens, INVENTION, seed)
        return await ask(self._model, request, shape, attempts=ATTEMPTS)

    async def _ask(
        self, purpose: str, system: str, user: str, seed: int, shape: type[T], check: Callable[[T], None]
    ) -> T:
        request = self._request(purpose, system, user, seed, INVENTION)
        return await ask(self._model, request, shape, check=check)

    def _request(self, purpose: str, system: str, user: str, seed: int, temperature: float) -> ChatRequest:
        messages = (Message(Speaker.SYSTEM, system), Message(Speaker.USER, user))
        return ChatRequest(purpose, messages, self._max_tokens, temperature, seed)


@functools.cache
def _small_things() -> str:
    """Return the names of small things that authored needs are about."""
    roles = (role for event in events() for need in event.needs for role in need.roles)
    kinds = {kind for role in roles if role.host for kind in role.kinds}
    return ", ".join(sorted(everyday_noun(kind) for kind in kinds))


def _unended(sentence: str) -> str:
    """Return a sentence without its full stop."""
    return sentence.strip().removesuffix(".")


def talk_of(turns: Sequence[DialogueTurn]) -> str:
    """Return the dialogue, one line for each turn."""
    return "\n".join(f"{turn.speaker}: {turn.text}" for turn in turns)
