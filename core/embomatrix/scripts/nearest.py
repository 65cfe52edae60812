"""Nearest-neighbour script: the demands of the training instruction with the most similar wording, on other objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.scripts.calls import Habits, ScriptDemand, plan_for
from embomatrix.scripts.mentions import Lexicon, Mention, tokens_of
from embomatrix.scripts.similarity import TermIndex, Words
from embomatrix.skills.syntax import MAX_STEPS, Plan, Skill, SkillCall
from embomatrix.world.state import State

if TYPE_CHECKING:
    from embomatrix.scripts.examples import ScriptExample
    from embomatrix.skills.prompt import PromptRow, Situation
    from embomatrix.world.intent import IntentClause

NEIGHBOURS: Final = 50
"""Training instructions that are tried until one fits the objects of the new one."""


class NearestScript:
    """Script that copies the demands of a neighbour. Similarity is the cosine of TF-IDF weights of words and word pairs."""

    def __init__(self, examples: Sequence[ScriptExample], lexicon: Lexicon, habits: Habits) -> None:
        self._examples = [example for example in examples if example.intent]
        self._lexicon = lexicon
        self._habits = habits
        self._index = TermIndex([self._wording(example.situation) for example in self._examples])

    @staticmethod
    def fit(examples: Sequence[ScriptExample]) -> NearestScript:
        """Learn instructions, demands, everyday names and machines of training tasks."""
        return NearestScript(examples, Lexicon.learned(examples), Habits.of(examples))

    def plan(self, situation: Situation) -> Plan:
        """Return the calls of the nearest instruction whose demands fit; without any, a move to the first row."""
        mentions = self._mentions(situation)
        for at in self._index.ranked(self._wording(situation))[:NEIGHBOURS]:
            demands = self._transferred(self._examples[at], mentions)
            if demands:
                return plan_for(demands, situation, self._habits)[:MAX_STEPS]
        return (SkillCall(Skill.MOVE, 0),)

    def _transferred(self, example: ScriptExample, mentions: Sequence[Mention]) -> list[ScriptDemand]:
        """Return a neighbour's demands on the objects that are mentioned at the same positions.

        Empty if the number of mentions differs, or an object can't meet a demand.
        """
        told = self._mentions(example.situation)
        if len(told) != len(mentions):
            return []

        def counterpart(names: Sequence[str]) -> tuple[PromptRow, ...]:
            fitting = (
                at for at, mention in enumerate(told) if any(row.name in names for row in mention.rows)
            )
            return next((mentions[at].rows for at in fitting), ())

        demands = [
            ScriptDemand(
                clause.predicate,
                clause.holds,
                _able(counterpart(clause.things), clause),
                counterpart(clause.places),
            )
            for clause in example.intent
        ]
        known = all(
            demand.things and bool(demand.places) == bool(clause.places)
            for demand, clause in zip(demands, example.intent, strict=True)
        )
        return demands if known else []

    def _wording(self, situation: Situation) -> Words:
        """Words of an instruction with ``thing`` for each object that can be carried, and ``place`` for each other one."""
        tokens = tokens_of(situation.instruction)
        words: list[str] = []
        at = 0
        for mention in self._mentions(situation):
            words += [*tokens[at : mention.start], "place" if mention.rows[0].fixed else "thing"]
            at = mention.end
        return tuple(word for word in (*words, *tokens[at:]) if word.isalnum())

    def _mentions(self, situation: Situation) -> list[Mention]:
        found = self._lexicon.mentions(tokens_of(situation.instruction), situation)
        return [mention for mention in found if not mention.is_pronoun]


def _able(rows: Sequence[PromptRow], clause: IntentClause) -> tuple[PromptRow, ...]:
    """Keep the rows that can meet a demand: those with a door or a switch in the right position, or those that move."""
    match clause.predicate:
        case State.OPEN:
            return tuple(row for row in rows if ("closed" if clause.holds else "open") in row.states)
        case State.TOGGLED_ON:
            return tuple(row for row in rows if ("off" if clause.holds else "on") in row.states)
        case _:
            return tuple(row for row in rows if not row.fixed)
