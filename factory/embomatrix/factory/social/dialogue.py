"""Conversation behind a request: needs, the robot's questions and refusals, and its confirmation of the whole request."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from embomatrix.factory.language.clauses import capitalised
from embomatrix.factory.language.nouns import listed, noun_of, number_word
from embomatrix.factory.social.day import NeedOfDay
from embomatrix.factory.social.knowledge import people_table
from embomatrix.factory.social.telling import Asked, Teller
from embomatrix.factory.social.values import ROBOT, Act, Cast, Conversation, DaySlot, DialogueTurn
from embomatrix.factory.writer.words import Voice

REFUSED_SHARE: Final = 0.6
"""Share of conversations with a chore that the robot refuses."""


def converse(asked: Sequence[Asked], teller: Teller, voice: Voice, room: str) -> Conversation:
    """Return the conversation about the needs of one event in this room. Raise UndescribableError."""
    first = asked[0].need
    talk = _Talk(teller, voice, first.person.name)
    talk.open(asked[0])
    for number, each in enumerate(asked):
        talk.request(each, is_first=not number)
        if not number and voice.rng.random() < REFUSED_SHARE:
            talk.refuse()
    wishes = talk.confirm(asked)
    slot = DaySlot(time=first.clock, person=first.person.name, room=room, activity=first.event.name)
    return Conversation(slot=slot, turns=tuple(talk.turns), first_wish=wishes[0], last_wishes=wishes)


class _Talk:
    def __init__(self, teller: Teller, voice: Voice, person: str) -> None:
        self.turns: list[DialogueTurn] = []
        self._teller = teller
        self._voice = voice
        self._person = person

    def open(self, first: Asked) -> None:
        why = capitalised(self._teller.reason(first.need))
        self._say(self._person, Act.NEED, "hello", why=why)

    def request(self, asked: Asked, *, is_first: bool) -> None:
        """Let the robot ask about the first thing, and the person answer with the whole need."""
        rows = self._teller.describer.rows
        name = asked.members[asked.conditions[0].things][0]
        noun = noun_of(rows[name].category)
        alike = sum(row.category == rows[name].category for row in rows.values())
        if is_first:
            self._say(
                ROBOT,
                Act.CLARIFY,
                "ask",
                thing=f"the {noun.at(len(asked.members[asked.conditions[0].things]))}",
            )
        wanted = self._teller.in_short(asked)
        if alike > len(asked.members[asked.conditions[0].things]):
            self._say(ROBOT, Act.CLARIFY, "which", alike=number_word(alike))
        act, kind = (Act.ANSWER, "answer") if is_first else (Act.ADD, "add")
        self._say(self._person, act, kind, do=listed(wanted))

    def refuse(self) -> None:
        chores = people_table()["chores"]
        chore = chores[int(self._voice.rng.integers(len(chores)))]
        self.turns.append(DialogueTurn(speaker=self._person, act=Act.ADD, text=chore["ask"]))
        self._say(ROBOT, Act.REFUSE, "refuse", reason=chore["reason"])

    def confirm(self, asked: Sequence[Asked]) -> tuple[str, ...]:
        """Let the robot repeat all requests, and return them."""
        wanted = tuple(each for need in asked for each in self._teller.in_short(need))
        self._say(ROBOT, Act.CONFIRM, "confirm", all=listed(wanted))
        return wanted

    def _say(self, speaker: str, act: Act, kind: str, **words: str) -> None:
        text = self._voice.choose(people_table()["talk"][kind]).format(**words)
        self.turns.append(DialogueTurn(speaker=speaker, act=act, text=capitalised(text)))


def transcript_of(
    cast: Cast, need: NeedOfDay, conversation: Conversation, instruction: str, goal_bddl: str
) -> str:
    """Return people, event, conversation and goal as Markdown."""
    people = "\n".join(
        f"* **{person.name}**, {person.age}, {person.job}, likes {person.hobby}"
        + "".join(f"; {tie} of {other}" for other, tie in person.ties.items())
        for person in cast.people
    )
    talk = "\n\n".join(
        f"**{'Robot' if turn.speaker == ROBOT else turn.speaker}** ({turn.act.value}): {turn.text}"
        for turn in conversation.turns
    )
    return (
        f"# {instruction}\n\n## The people\n\n{capitalised(cast.setting)}.\n\n{people}\n\n"
        f"## {capitalised(need.time)}: {need.event.name}\n\n{talk}\n\n## What is to be true\n\n`{goal_bddl}`\n"
    )
