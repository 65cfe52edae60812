"""Template script: reads an instruction with the phrases of the training split and writes the calls by fixed rules."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from embomatrix.scripts.calls import Habits, ScriptDemand, plan_for
from embomatrix.scripts.clauses import ClauseMeaning, ClauseTemplates, ReadClause, aligned
from embomatrix.scripts.joining import readings
from embomatrix.scripts.mentions import Lexicon, Mention, tokens_of
from embomatrix.skills.syntax import MAX_STEPS, Plan, Skill, SkillCall
from embomatrix.world.state import THERMAL, State

if TYPE_CHECKING:
    from embomatrix.scripts.examples import ScriptExample
    from embomatrix.scripts.similarity import Words
    from embomatrix.skills.prompt import PromptRow, Situation


class TemplateScript:
    """Script that knows every phrase, everyday name and machine of the training split, and the prompt of its task."""

    def __init__(self, templates: ClauseTemplates, lexicon: Lexicon, habits: Habits) -> None:
        self._templates = templates
        self._lexicon = lexicon
        self._habits = habits

    @staticmethod
    def fit(examples: Sequence[ScriptExample]) -> TemplateScript:
        """Learn phrases, names and machines from training tasks. Tasks without an intent teach no phrases."""
        lexicon = Lexicon.learned(examples)
        told = [(tokens_of(example.situation.instruction), example) for example in examples if example.intent]
        clauses = [
            clause
            for tokens, example in told
            for clause in aligned(tokens, lexicon.mentions(tokens, example.situation), example.intent)
        ]
        return TemplateScript(ClauseTemplates(clauses), lexicon, Habits.of(examples))

    def plan(self, situation: Situation) -> Plan:
        """Return the calls of the demands that the script understands; without any, a move to the first row."""
        calls = plan_for(self.demands(situation), situation, self._habits)
        return calls[:MAX_STEPS] or (SkillCall(Skill.MOVE, 0),)

    def demands(self, situation: Situation) -> list[ScriptDemand]:
        """Read the demands of an instruction, in order.

        A pronoun stands for the things of the demand before it. A place that was named before is meant again.
        """
        tokens = tokens_of(situation.instruction)
        found: list[ScriptDemand] = []
        things: list[tuple[PromptRow, ...]] = []
        mentions, clauses = self._best_reading(tokens, situation)
        for clause in clauses:
            meaning = clause.meaning
            named = mentions[clause.first + meaning.thing]
            if not named.is_pronoun:
                things = _chosen(named, meaning)
            elif not things:
                things = _antecedent(mentions, clause.first + meaning.thing)
            at = None if meaning.place is None else mentions[clause.first + meaning.place]
            places = () if at is None else at.rows
            if at is not None and at.is_pronoun and found:
                places = found[-1].places or found[-1].things
            known = {demand.places[0] for demand in found if demand.places}
            places = tuple(sorted(places, key=lambda row: row not in known))
            found += [ScriptDemand(meaning.predicate, meaning.holds, rows, places) for rows in things]
        return found

    def _best_reading(
        self, tokens: Words, situation: Situation
    ) -> tuple[Sequence[Mention], Sequence[ReadClause]]:
        """Return the mentions, joined where that explains the words better, and the clauses."""
        best: tuple[float, Sequence[Mention], Sequence[ReadClause]] = (-1.0, (), ())
        for mentions in readings(tokens, self._lexicon.mentions(tokens, situation)):
            score, clauses = self._templates.read(tokens, mentions)
            if score > best[0]:
                best = (score, mentions, clauses)
        return best[1], best[2]


def _antecedent(mentions: Sequence[Mention], pronoun: int) -> list[tuple[PromptRow, ...]]:
    """Return the last object before a pronoun that can be carried; empty if there is none."""
    loose = (tuple(row for row in mention.rows if not row.fixed) for mention in reversed(mentions[:pronoun]))
    return [rows for rows in loose if rows][:1]


def _chosen(mention: Mention, meaning: ClauseMeaning) -> list[tuple[PromptRow, ...]]:
    """Return the things that a mention denotes, each with its alternatives."""
    found: list[tuple[PromptRow, ...]] = []
    for part in mention.each:
        rows = sorted(part.rows, key=lambda row: not _is_suitable(row, meaning))
        if part.count == 1:
            found.append(tuple(rows))
        else:
            found += [(row,) for row in (rows[: part.count] if part.count else rows)]
    return found


def _is_suitable(row: PromptRow, meaning: ClauseMeaning) -> bool:
    """Return True if the demand makes sense for the row: a lamp that is off can be switched on, a table can't be lifted."""
    match meaning.predicate:
        case State.OPEN:
            return ("closed" if meaning.holds else "open") in row.states
        case State.TOGGLED_ON:
            return ("off" if meaning.holds else "on") in row.states
        case predicate if meaning.place is not None or predicate in THERMAL:
            return not row.fixed
        case _:
            return True
