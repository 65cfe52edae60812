"""A task's story in Markdown: who, when, what was said, and what became of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.factory.social.values import ROBOT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.factory.social.values import Cast, Conversation
    from embomatrix.factory.writer.goals import GoalConjunct


def transcript_of(
    cast: Cast, conversation: Conversation, instruction: str, pieces: Sequence[GoalConjunct]
) -> str:
    """All that led to the task, for a reader."""
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
    signs = "\n".join(f"* {sign}" for piece in pieces for sign in piece.signs)
    return (
        f"# {instruction}\n\n## The people\n\n{cast.setting[:1].upper()}{cast.setting[1:]}.\n\n{people}\n\n"
        f"## {slot.time}, {slot.room}: {slot.person} is {slot.activity}\n\n{talk}\n\n## What is to be true\n\n{signs}\n"
    )
