"""Random variation of prompts and plans: properties that must not matter to a policy change in both alike.

Varied are the row order, instance numbers, the choice of bystanders, and category names. A category that the instruction
names may get any other name: the instruction says what to do, and the table lists doors and switches, so the policy
learns to read them instead of memorising typical uses. A category that the instruction does not name may still be meant
("cook the steak"), so it is only renamed to one *of its kind* (same abilities, fixed or not), which keeps the plan valid.
Held-out tasks contribute category names only, never their instructions, goals or plans.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import Situation, subset
from embomatrix.skills.syntax import Plan

if TYPE_CHECKING:
    import numpy as np

_WORD: Final = re.compile(r"[a-z0-9_]+", re.IGNORECASE)
_MAX_PHRASE_WORDS: Final = 6
"""Maximum words of a category name."""
_KEEP_SHARE: Final = 0.2
"""Share of categories that keep their name in a renamed prompt."""


@dataclass(frozen=True, slots=True)
class Variation:
    """Strength of the variation. ``rename``: probability per prompt; ``drop``: maximum share of bystanders left out."""

    kinds: Mapping[str, tuple[str, ...]]
    """Category to all categories of its kind, including itself."""
    rename: float = 0.5
    drop: float = 0.5


def used_rows(plan: Plan) -> frozenset[int]:
    """Return the table rows that a plan uses."""
    calls = [(call.object_index, call.source_index) for call in plan]
    return frozenset(index for pair in calls for index in pair if index is not None)


def drop_bystanders(
    situation: Situation, needed: frozenset[int], drop: float, rng: np.random.Generator
) -> Situation:
    """Leave out a random share, at most ``drop``, of the rows that are neither needed nor hold a needed one."""
    hosts = {row.host for row in situation.rows if row.index in needed and row.host}
    share = rng.uniform(0.0, drop)
    kept = [
        row.index
        for row in situation.rows
        if row.index in needed or row.name in hosts or rng.random() >= share
    ]
    return subset(situation, kept)


def vary(situation: Situation, variation: Variation, rng: np.random.Generator) -> Situation:
    """Shuffle rows and instance numbers, and perhaps rename categories."""
    order = rng.permutation(len(situation.rows))
    situation = replace(situation, rows=tuple(situation.rows[int(at)] for at in order))
    if rng.random() < variation.rename:
        situation = _renamed(situation, variation.kinds, rng)
    return _renumbered(situation, rng)


def _renumbered(situation: Situation, rng: np.random.Generator) -> Situation:
    """Shuffle the names within each category, in the table and in the instruction."""
    names: dict[str, str] = {}
    by_category: dict[str, list[str]] = {}
    for row in situation.rows:
        by_category.setdefault(row.category, []).append(row.name)
    for members in by_category.values():
        shuffled = rng.permutation(members)
        names |= {old: str(new) for old, new in zip(members, shuffled, strict=True)}
    return _with_names(situation, names, {})


def _renamed(
    situation: Situation, kinds: Mapping[str, tuple[str, ...]], rng: np.random.Generator
) -> Situation:
    """Swap category names, each at most once. Names that the instruction contains are never given."""
    taken = {row.category for row in situation.rows}
    phrases = _phrases(situation.instruction)
    new: dict[str, str] = {}
    for category in dict.fromkeys(row.category for row in situation.rows):
        choices = kinds if _as_words(category) in phrases else kinds.get(category, ())
        free = [word for word in choices if word not in taken and _as_words(word) not in phrases]
        if not free or rng.random() < _KEEP_SHARE:
            continue
        new[category] = free[int(rng.integers(len(free)))]
        taken.add(new[category])
    names = {
        row.name: _renamed_name(row.name, row.category, new[row.category])
        for row in situation.rows
        if row.category in new
    }
    return _with_names(situation, names, new)


def _renamed_name(name: str, category: str, new: str) -> str:
    return new + name.removeprefix(category) if name.startswith(category) else name


def _with_names(situation: Situation, names: Mapping[str, str], categories: Mapping[str, str]) -> Situation:
    rows = tuple(
        replace(
            row,
            name=names.get(row.name, row.name),
            category=categories.get(row.category, row.category),
            host=names.get(row.host, row.host),
        )
        for row in situation.rows
    )
    instruction = _replaced(situation.instruction, {**names, **categories})
    return replace(situation, rows=rows, instruction=instruction)


def _replaced(text: str, words: Mapping[str, str]) -> str:
    """Apply all replacements at once, longest first, so no replacement is replaced again.

    Words stay words ("pen" becomes "chicken leg") and names stay names ("pen_1" becomes "chicken_leg_1").
    """
    changes = {**words, **{_as_words(old): _as_words(new) for old, new in words.items()}}
    longest = max((phrase.count(" ") + 1 for phrase in changes), default=0)
    spans = [match.span() for match in _WORD.finditer(text)]
    parts: list[str] = []
    at = copied = 0
    while at < len(spans):
        for size in range(min(longest, len(spans) - at), 0, -1):
            begin, end = spans[at][0], spans[at + size - 1][1]
            new = changes.get(text[begin:end].lower())
            if new is not None:
                parts += [text[copied:begin], new]
                copied = end
                break
        else:
            size = 1
        at += size
    return "".join([*parts, text[copied:]])


def _as_words(word: str) -> str:
    return word.replace("_", " ")


def _phrases(text: str) -> frozenset[str]:
    """All runs of up to ``_MAX_PHRASE_WORDS`` words of a text, in lower case."""
    text = text.lower()
    spans = [match.span() for match in _WORD.finditer(text)]
    return frozenset(
        text[spans[begin][0] : spans[end][1]]
        for begin in range(len(spans))
        for end in range(begin, min(begin + _MAX_PHRASE_WORDS, len(spans)))
    )
