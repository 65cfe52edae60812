"""One task, told in many ways: what must not matter to a policy is varied, in the prompt and in the plan alike.

Row order, instance numbers, the choice of bystanders, and the names of categories. What the instruction names may get the
name of anything at all: its words say what to do with it, and the table tells its doors and switches, so that a policy
learns to go by them and not by what it mostly does with a thing of that name. What the instruction doesn't name may be meant
all the same ("cook the steak"): it is renamed only to one *of its kind* (same abilities, fixed or not), so that what the plan
does stays right for what the prompt says. Held-out tasks lend their category words, never their instructions, goals or plans.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import subset

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from embomatrix.skills.prompt import Situation
    from embomatrix.skills.syntax import Plan

_WORD: Final = re.compile(r"[a-z0-9_]+", re.IGNORECASE)
_LONGEST: Final = 6
"""Words of a category's name at most."""
_KEPT: Final = 0.2
"""Share of categories that keep their word in a telling with other words."""


@dataclass(frozen=True, slots=True)
class Variation:
    """How much is varied: ``rename`` is a probability per telling, ``drop`` the largest share of bystanders left out."""

    kinds: Mapping[str, tuple[str, ...]]
    """Category to all categories of its kind, itself included."""
    rename: float = 0.5
    drop: float = 0.5


def used_rows(plan: Plan) -> frozenset[int]:
    """Rows that a plan calls."""
    calls = [(call.object_index, call.source_index) for call in plan]
    return frozenset(index for pair in calls for index in pair if index is not None)


def with_fewer_bystanders(
    situation: Situation, needed: frozenset[int], drop: float, rng: np.random.Generator
) -> Situation:
    """Leave out a random share, at most ``drop``, of the rows that are neither needed nor host a needed one."""
    hosts = {row.host for row in situation.rows if row.index in needed and row.host}
    share = rng.uniform(0.0, drop)
    kept = [
        row.index
        for row in situation.rows
        if row.index in needed or row.name in hosts or rng.random() >= share
    ]
    return subset(situation, kept)


def varied(situation: Situation, variation: Variation, rng: np.random.Generator) -> Situation:
    """The same situation in other words: rows in another order, other instance numbers, perhaps other categories."""
    order = rng.permutation(len(situation.rows))
    situation = replace(situation, rows=tuple(situation.rows[int(at)] for at in order))
    if rng.random() < variation.rename:
        situation = _renamed(situation, variation.kinds, rng)
    return _renumbered(situation, rng)


def _renumbered(situation: Situation, rng: np.random.Generator) -> Situation:
    """Shuffle the names among the rows of each category; the instruction's full names follow."""
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
    """Give categories the words of others, each word to one category at most; no word that the instruction holds."""
    taken = {row.category for row in situation.rows}
    spoken = _phrases(situation.instruction)
    new: dict[str, str] = {}
    for category in dict.fromkeys(row.category for row in situation.rows):
        choices = kinds if _spoken(category) in spoken else kinds.get(category, ())
        free = [word for word in choices if word not in taken and _spoken(word) not in spoken]
        if not free or rng.random() < _KEPT:
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
    """All replacements at once, longest first: a word that was put in is not replaced again.

    Spoken words stay spoken ("pen" becomes "chicken leg") and names stay names ("pen_1" becomes "chicken_leg_1").
    """
    changes = {**words, **{_spoken(old): _spoken(new) for old, new in words.items()}}
    longest = max((phrase.count(" ") + 1 for phrase in changes), default=0)
    spans = [match.span() for match in _WORD.finditer(text)]
    parts: list[str] = []
    at = told = 0
    while at < len(spans):
        for size in range(min(longest, len(spans) - at), 0, -1):
            begin, end = spans[at][0], spans[at + size - 1][1]
            new = changes.get(text[begin:end].lower())
            if new is not None:
                parts += [text[told:begin], new]
                told = end
                break
        else:
            size = 1
        at += size
    return "".join([*parts, text[told:]])


def _spoken(word: str) -> str:
    return word.replace("_", " ")


def _phrases(text: str) -> frozenset[str]:
    """Every run of up to ``_LONGEST`` words of a text, as it stands there in small letters."""
    text = text.lower()
    spans = [match.span() for match in _WORD.finditer(text)]
    return frozenset(
        text[spans[begin][0] : spans[end][1]]
        for begin in range(len(spans))
        for end in range(begin, min(begin + _LONGEST, len(spans)))
    )
