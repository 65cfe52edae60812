"""Audit of an instruction against the goal that is scored: each must demand what the other does.

The words are compared with the writer's intent, and the intent with the goal. Nouns are the categories' names and their
everyday names.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

from embomatrix.factory.language.nouns import everyday_noun
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.words import spoken
from embomatrix.world.intent import IntentClause, goal_clauses
from embomatrix.world.state import THERMAL, Relation, State
from embomatrix.world.task import Task

_PREPOSITIONS: Final = {
    Relation.INSIDE: r"in|inside|into|within",
    Relation.ONTOP: r"on|onto|upon|on top of",
}
_BETWEEN: Final = r"(?:the|a|an|this|that|one of the|any|some)?\s*"
"""Words between a preposition and the noun of the place."""


def audit(task: Task, intent: Sequence[IntentClause], view: SceneView) -> tuple[str, ...]:
    """Return a sentence for each way in which instruction, intent and goal disagree; empty if none is found."""
    text = task.instruction.lower()
    found = (
        *_goal_differs(task, intent),
        *_raw_names(task.instruction, view),
        *(sentence for clause in intent for sentence in _of_clause(text, clause, intent, view)),
    )
    return tuple(dict.fromkeys(found))


def _goal_differs(task: Task, intent: Sequence[IntentClause]) -> Iterator[str]:
    """Compare the intent with the goal, clause by clause."""
    scored = goal_clauses(task.goal, task.types)
    here, there = set(map(_key, intent)), set(map(_key, scored))
    unscored = [clause for clause in intent if _key(clause) not in there]
    unsaid = [clause for clause in scored if _key(clause) not in here]
    for clause in unscored:
        twin = next((other for other in unsaid if _key(other)[:3] == _key(clause)[:3]), None)
        if twin is not None:
            unsaid.remove(twin)
        goal = f"only {_in_words(twin)}" if twin is not None else "does not"
        yield f"the instruction demands {_in_words(clause)}, and the goal {goal}"
    for clause in unsaid:
        yield f"the goal demands {_in_words(clause)}, and the instruction does not"


def _key(clause: IntentClause) -> tuple[str, frozenset[str], bool, frozenset[str]]:
    return clause.predicate, frozenset(clause.things), clause.holds, frozenset(clause.places)


def _in_words(clause: IntentClause) -> str:
    words = (clause.predicate, "/".join(clause.things), "/".join(clause.places))
    atom = f"({' '.join(filter(None, words))})"
    return atom if clause.holds else f"(not {atom})"


def _raw_names(instruction: str, view: SceneView) -> Iterator[str]:
    for word in re.findall(r"\w+_\d+", instruction):
        if word in view.scene.by_name:
            yield f"the instruction names {word}, an object of the scene: call it as people do"


def _of_clause(
    text: str, clause: IntentClause, intent: Sequence[IntentClause], view: SceneView
) -> Iterator[str]:
    """Compare the words with one clause: nouns, the relation's preposition, the source, and whether the noun is unique."""
    for names in filter(None, (clause.things, clause.places)):
        if not any(_is_mentioned(text, noun) for name in names for noun in nouns_of(view.category(name))):
            yield f"the instruction does not mention {'/'.join(names)}"
        others = set(_alike(view, names)) - set(names)
        if others:
            yield f"the words for {'/'.join(names)} also fit {min(others)}: say which, or accept any"
    if clause.predicate in _PREPOSITIONS and clause.places:
        yield from _wrong_preposition(text, clause, view)
    if clause.predicate in THERMAL and not clause.places:
        sources = _sources_named(text, clause, intent, view)
        if sources:
            yield f"the instruction names {'/'.join(sources)} as the source, and the goal accepts any"


def nouns_of(category: str) -> tuple[str, ...]:
    """Return the nouns for a category."""
    return tuple(dict.fromkeys((spoken(category).lower(), everyday_noun(category).lower())))


def _is_mentioned(text: str, noun: str) -> bool:
    return re.search(rf"\b{re.escape(noun)}s?\b", text) is not None


def _alike(view: SceneView, names: Iterable[str]) -> Iterator[str]:
    """Yield all objects that the words for these ones fit: those of their category in their room."""
    for name in names:
        yield from view.alike(name)


def _wrong_preposition(text: str, clause: IntentClause, view: SceneView) -> Iterator[str]:
    """Report a place if the words use the preposition of the other relation, and never that of the scored one."""
    nouns = "|".join(
        re.escape(noun)
        for noun in sorted({noun for name in clause.places for noun in nouns_of(view.category(name))})
    )

    def occurs(relation: Relation) -> bool:
        return re.search(rf"\b(?:{_PREPOSITIONS[relation]})\s+{_BETWEEN}(?:{nouns})\b", text) is not None

    wanted = Relation(clause.predicate)
    other = Relation.ONTOP if wanted is Relation.INSIDE else Relation.INSIDE
    if occurs(other) and not occurs(wanted):
        yield f"the instruction says {other.value} {'/'.join(clause.places)}, and the goal {wanted.value}"


def _sources_named(
    text: str, clause: IntentClause, intent: Sequence[IntentClause], view: SceneView
) -> tuple[str, ...]:
    """Return the objects that can cause the thermal state and that the words name as its source.

    Objects that are places in the intent are left out, as in *cook it and leave it in the oven*.
    """
    state = State(clause.predicate)
    places = {name for other in intent for name in other.places}
    able = [
        item.name
        for item in view.scene.objects
        if item.name not in places
        and any(state in view.thermal_effects(thing, item.name) for thing in clause.things)
    ]
    return tuple(
        name
        for name in able
        if any(
            re.search(rf"\b(?:with|use|using|in|on|at|by)\s+{_BETWEEN}{re.escape(noun)}\b", text)
            for noun in nouns_of(view.category(name))
        )
    )


def read_intent(task: Task, view: SceneView) -> tuple[IntentClause, ...]:
    """Return the intent of a task whose writer stated none: its goal, with the sources that the instruction names."""
    text, clauses = task.instruction.lower(), goal_clauses(task.goal, task.types)
    return tuple(
        replace(clause, places=_sources_named(text, clause, clauses, view))
        if clause.predicate in THERMAL and not clause.places
        else clause
        for clause in clauses
    )
