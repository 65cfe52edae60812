"""Rule-based Summarization Agent: instruction and transcript of a conversation."""

from collections.abc import Sequence

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.phrases import INSTRUCTIONS, fill, joined, room_called, shorten_repeated_rooms
from embomatrix.factory.social.values import ROBOT, Cast, Conversation
from embomatrix.factory.writer.goals import GoalConjunct
from embomatrix.factory.writer.words import Voice


def instruction_of(conversation: Conversation, cast: Cast, view: SceneView, voice: Voice, why: str) -> str:
    """Return one or two sentences with the final requests in their order. ``why`` is a clause with the reason."""
    slot = conversation.slot
    who = cast.of(slot.person)
    others = [person.name for person in cast.people if person.name != who.name]
    what = joined(conversation.last_wishes, voice)
    text = fill(
        voice.choose(INSTRUCTIONS),
        who=who.name,
        other=others[int(voice.rng.integers(len(others)))],
        what=what,
        activity=slot.activity,
        time=slot.time,
        room=room_called(view, slot.room),
        job=who.job,
        age=str(who.age),
        hobby=who.hobby,
        why=why,
    )
    return shorten_repeated_rooms(text, view)


def transcript_of(
    cast: Cast, conversation: Conversation, instruction: str, conjuncts: Sequence[GoalConjunct]
) -> str:
    """Return the conversation, its people and the goal as Markdown."""
    slot = conversation.slot
    people = "\n".join(
        f"* **{person.name}**, {person.age}, {person.job}, likes {person.hobby}"
        + "".join(f"; {tie} of {other}" for other, tie in person.ties.items())
        for person in cast.people
    )
    talk = "\n\n".join(
        f"**{'Robot' if turn.speaker == ROBOT else turn.speaker}** ({turn.act.value}): {turn.text}"
        for turn in conversation.turns
    )
    signs = "\n".join(f"* {sign}" for conjunct in conjuncts for sign in conjunct.signs)
    return (
        f"# {instruction}\n\n## The people\n\n{cast.setting[:1].upper()}{cast.setting[1:]}.\n\n{people}\n\n"
        f"## {slot.time}, {slot.room}: {slot.person} is {slot.activity}\n\n{talk}\n\n## What is to be true\n\n{signs}\n"
    )
