"""One task, told in many ways: what must not matter to a policy is varied, in the prompt and in the plan alike.

Row order, instance numbers, the choice of bystanders, and the names of categories. A category is renamed only to one
*of the same kind* (same abilities, fixed or not), so that what the plan does stays right for what the prompt says.
Held-out tasks lend their category words, never their instructions, goals or plans.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from embomatrix.skills.prompt import subset

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from embomatrix.skills.prompt import Situation
    from embomatrix.skills.syntax import Plan


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
    """Give categories the words of others of their kind, each word to one category at most.

    A category that the instruction does not name keeps its word while it may be meant by another one ("the oven" for a
    stove): only a word found in the instruction, or a bystander's, is exchanged.
    """
    taken = {row.category for row in situation.rows}
    new: dict[str, str] = {}
    for category in dict.fromkeys(row.category for row in situation.rows):
        free = [word for word in kinds.get(category, ()) if word not in taken]
        free = [word for word in free if not _phrase(word).search(situation.instruction.lower())]
        if not free or rng.random() < 0.2:
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
    spoken = {old.replace("_", " "): new.replace("_", " ") for old, new in words.items()}
    changes = {**words, **spoken}
    if not changes:
        return text
    choices = "|".join(re.escape(old) for old in sorted(changes, key=len, reverse=True))
    pattern = re.compile(rf"(?<![a-z0-9_])({choices})(?![a-z0-9_])", re.IGNORECASE)
    return pattern.sub(lambda match: changes[match[1].lower()], text)


def _phrase(word: str) -> re.Pattern[str]:
    return re.compile(rf"(?<![a-z0-9_]){re.escape(word.replace('_', ' '))}(?![a-z0-9_])")
