"""Role-Playing, Social Simulation and Summarization Agent on a language model.

Each agent requests a typed answer and checks it against the scene. Problems are returned to the model as a sentence.
The scene's description is marked as data, so that instructions in names are ignored.
"""

from typing import Annotated, Final

from pydantic import Field

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.facts import SceneFacts
from embomatrix.factory.social.prompts import (
    CAST_SYSTEM,
    CAST_USER,
    CATEGORY_HINTS,
    ROBOT_LIMITS,
    SIGHT_SYSTEM,
    SIGHT_USER,
    SUMMARY_SYSTEM,
    SUMMARY_USER,
    TALK_SYSTEM,
    TALK_USER,
    answer_schema,
)
from embomatrix.factory.social.requests import TaskRequest, check_request
from embomatrix.factory.social.values import (
    ROBOT,
    Act,
    Cast,
    Conversation,
    DaySlot,
    DialogueTurn,
    StrictModel,
)
from embomatrix.llm.structured import ask
from embomatrix.llm.values import ChatModel, ChatRequest, Message, Speaker
from embomatrix.world.task import TaskCategory

SIGHT: Final = "scene information extraction"
CAST: Final = "role-playing agent"
TALK: Final = "social simulation agent"
SUMMARY: Final = "summarization agent"
"""Purposes of the requests, for ledgers and errors."""
TEMPERATURE: Final = 0.9
"""Sampling temperature of invented content."""


class RoomSighting(StrictModel):
    """Description of each room by a vision model."""

    rooms: dict[str, Annotated[str, Field(min_length=10, max_length=300, pattern=r"^[^\n<>]*$")]]


class ConversationAnswer(StrictModel):
    """Conversation as written by the model."""

    turns: tuple[DialogueTurn, ...] = Field(min_length=4, max_length=14)
    first_wish: str = Field(min_length=3, max_length=200)
    last_wishes: tuple[str, ...] = Field(min_length=1, max_length=6)


class SocialModelAgents:
    """Social agents on one model. ``max_tokens`` limits an answer."""

    def __init__(self, model: ChatModel, *, max_tokens: int = 2048) -> None:
        self._model = model
        self._max_tokens = max_tokens

    async def describe(self, facts: SceneFacts, pictures: tuple[bytes, ...], seed: int) -> RoomSighting:
        """Describe the rooms from pictures in PNG format. Raise LlmError."""
        rooms = [room.name for room in facts.rooms]

        def check(sight: RoomSighting) -> None:
            if unknown := sorted(set(sight.rooms) - set(rooms)):
                raise ValueError(f"there is no room {unknown[0]!r}: the rooms are {', '.join(rooms)}")
            if missing := [room for room in rooms if room not in sight.rooms]:
                raise ValueError(f"no sentence describes {', '.join(missing)}: give each room a sentence")

        user = Message(Speaker.USER, SIGHT_USER.format(scene=facts.described()), pictures)
        messages = (Message(Speaker.SYSTEM, SIGHT_SYSTEM), user)
        request = ChatRequest(SIGHT, messages, self._max_tokens, 0.2, seed)
        return await ask(self._model, request, RoomSighting, check=check)

    async def cast(self, facts: SceneFacts, seed: int) -> Cast:
        """Invent people who suit the scene and cover every room. Raise LlmError."""
        rooms = [room.name for room in facts.rooms]

        def check(cast: Cast) -> None:
            if unknown := sorted(cast.rooms - set(rooms)):
                raise ValueError(f"there is no room {unknown[0]!r}: the rooms are {', '.join(rooms)}")
            if empty := [room for room in rooms if room not in cast.rooms]:
                raise ValueError(f"nobody is ever in {', '.join(empty)}: give each of these rooms somebody")

        request = self._request(CAST, CAST_SYSTEM.format(), CAST_USER.format(scene=facts.described()), seed)
        return await ask(self._model, request, Cast, check=check)

    async def converse(
        self, facts: SceneFacts, cast: Cast, slot: DaySlot, category: TaskCategory, seed: int
    ) -> Conversation:
        """Write a conversation between people and the robot that leads to a request. Raise LlmError."""

        def check(talk: ConversationAnswer) -> None:
            speakers = {turn.speaker for turn in talk.turns}
            if unknown := sorted(speakers - {ROBOT, *cast.names}):
                raise ValueError(
                    f"there is no speaker {unknown[0]!r}: the speakers are {ROBOT}, {', '.join(cast.names)}"
                )
            if (
                ROBOT not in speakers
                or talk.turns[-1].act is not Act.CONFIRM
                or talk.turns[-1].speaker != ROBOT
            ):
                raise ValueError("the robot must take part, and confirm the whole request in the last turn")

        user = TALK_USER.format(
            scene=facts.described(),
            people="\n".join(
                f"{each.name}, {each.age}, {each.job}, likes {each.hobby}" for each in cast.people
            ),
            time=slot.time,
            room=slot.room,
            person=slot.person,
            activity=slot.activity,
            hint=CATEGORY_HINTS[category.value],
        )
        request = self._request(TALK, TALK_SYSTEM.format(limits=ROBOT_LIMITS), user, seed)
        talk = await ask(self._model, request, ConversationAnswer, check=check)
        return Conversation(
            slot=slot, turns=talk.turns, first_wish=talk.first_wish, last_wishes=talk.last_wishes
        )

    async def summarise(
        self, facts: SceneFacts, view: SceneView, conversation: Conversation, seed: int
    ) -> TaskRequest:
        """Summarise the conversation as a request about existing objects. Raise LlmError."""
        known = frozenset(facts.things)
        said = "\n".join(f"{turn.speaker}: {turn.text}" for turn in conversation.turns)
        user = SUMMARY_USER.format(scene=facts.described(), conversation=said)
        request = self._request(SUMMARY, SUMMARY_SYSTEM, user, seed)
        return await ask(
            self._model, request, TaskRequest, check=lambda wanted: check_request(wanted, view, known)
        )

    def _request(self, purpose: str, system: str, user: str, seed: int) -> ChatRequest:
        messages = (Message(Speaker.SYSTEM, system), Message(Speaker.USER, user))
        return ChatRequest(purpose, messages, self._max_tokens, TEMPERATURE, seed, answer_schema(purpose))
