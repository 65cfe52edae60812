"""Dialogue of people with their robot: one call for each speaker and turn, each with the speaker's own knowledge."""

from collections.abc import Callable, Iterator
from typing import Final

from embomatrix.factory.social.model.agents import TURN, SocialModelAgents
from embomatrix.factory.social.model.answers import EventAnswer, Household
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import ROBOT, Act, Conversation, DialogueTurn
from embomatrix.llm.values import UnusableReplyError

MIN_TURNS: Final = 4
"""Number of turns after which a confirmation of the robot ends the dialogue."""
MAX_TURNS: Final = 6


async def converse(
    agents: SocialModelAgents,
    scene: SceneKinds,
    household: Household,
    event: EventAnswer,
    seeds: Callable[[int], int],
) -> tuple[DialogueTurn, ...]:
    """Return a dialogue that the robot's confirmation ends. ``seeds`` gives each turn its seed.

    Raise LlmError, also if the robot never confirms.
    """
    turns: list[DialogueTurn] = []
    for number, speaker in enumerate(_speakers(event)):
        seed = seeds(number)
        if speaker == ROBOT:
            turns.append(await agents.robot_turn(scene, turns, seed, is_last=number >= MIN_TURNS - 1))
        else:
            turns.append(await agents.person_turn(scene, household, event, speaker, turns, seed))
        if number >= MIN_TURNS - 1 and turns[-1].act is Act.CONFIRM:
            return tuple(turns)
    raise UnusableReplyError(f"{TURN}: the robot confirmed nothing in {MAX_TURNS} turns")


def conversation_of(
    event: EventAnswer, turns: tuple[DialogueTurn, ...], instructions: tuple[str, ...]
) -> Conversation:
    """Return the conversation with the instructions that it led to."""
    return Conversation(slot=event.slot(), turns=turns, first_wish=turns[0].text, last_wishes=instructions)


def _speakers(event: EventAnswer) -> Iterator[str]:
    """Yield the speakers in turn. A second person speaks third; without one, the first person answers."""
    has_other = bool(event.other and event.other_need)
    yield from (event.person, ROBOT, event.other if has_other else event.person, ROBOT, event.person, ROBOT)
