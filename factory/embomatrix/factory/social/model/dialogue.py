"""Dialogue of people with their robot: one call for each speaker and turn, each with the speaker's own knowledge."""

from collections.abc import Callable, Sequence
from typing import Final

from embomatrix.factory.social.model.agents import TURN, SocialModelAgents
from embomatrix.factory.social.model.answers import EventAnswer, Household
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import ROBOT, Act, Conversation, DialogueTurn
from embomatrix.llm.values import UnusableReplyError

MIN_TURNS: Final = 4
"""Number of turns after which a confirmation of the robot ends the dialogue, if everybody has spoken."""
MAX_TURNS: Final = 8


async def converse(
    agents: SocialModelAgents,
    scene: SceneKinds,
    household: Household,
    event: EventAnswer,
    seeds: Callable[[int], int],
) -> tuple[DialogueTurn, ...]:
    """Return a dialogue that the robot's confirmation ends, or a person's thanks for it. ``seeds`` gives each turn its seed.

    Raise LlmError, also if the robot never confirms.
    """
    turns: list[DialogueTurn] = []
    for number in range(MAX_TURNS):
        speaker = _next_speaker(event, turns)
        if speaker == ROBOT:
            is_last = number >= MIN_TURNS - 1 and not _waiting(event, turns)
            turns.append(await agents.robot_turn(scene, event, turns, seeds(number), is_last=is_last))
            if is_last and turns[-1].act is Act.CONFIRM:
                return tuple(turns)
        else:
            turns.append(await agents.person_turn(scene, household, event, speaker, turns, seeds(number)))
            is_confirmed = any(turn.act is Act.CONFIRM for turn in turns)
            if turns[-1].act is Act.THANKS and is_confirmed and not _waiting(event, turns):
                return tuple(turns)
    raise UnusableReplyError(f"{TURN}: the robot confirmed nothing in {MAX_TURNS} turns")


def conversation_of(
    event: EventAnswer, turns: tuple[DialogueTurn, ...], instructions: tuple[str, ...]
) -> Conversation:
    """Return the conversation with the instructions that it led to."""
    return Conversation(slot=event.slot(), turns=turns, first_wish=turns[0].text, last_wishes=instructions)


def _next_speaker(event: EventAnswer, turns: Sequence[DialogueTurn]) -> str:
    """Return who speaks next. A person whom the robot has asked answers once before a second person speaks."""
    if not turns:
        return event.person
    if turns[-1].speaker != ROBOT:
        return ROBOT
    asked = turns[-2].speaker
    has_answered = sum(turn.speaker == asked for turn in turns) > 1
    is_open = turns[-1].act is not Act.CONFIRM and not has_answered
    return asked if is_open else _waiting(event, turns) or asked


def _waiting(event: EventAnswer, turns: Sequence[DialogueTurn]) -> str:
    """Return the second person with a need who has not spoken yet; "" for none."""
    has_other = bool(event.other and event.other_need)
    return event.other if has_other and all(turn.speaker != event.other for turn in turns) else ""
