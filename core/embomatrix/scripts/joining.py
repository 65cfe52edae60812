"""Joined mentions: ``the cup and the plate``, and ``the cup on the desk`` for the cup that stands there."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.scripts.mentions import Mention
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.scripts.similarity import Words

_LISTED: Final = frozenset({("and",), (",",), (",", "and")})
"""Tokens between two members of a list."""
_RELATIONS: Final = {
    "on": Relation.ONTOP,
    "in": Relation.INSIDE,
    "inside": Relation.INSIDE,
    "under": Relation.UNDER,
}
_MOST_BETWEEN: Final = 4
"""Tokens between an object and its place, such as ``that is lying on``."""
_MOST_JOINTS: Final = 4
"""Pairs of mentions that are tried joined and apart."""


def readings(tokens: Words, mentions: Sequence[Mention]) -> Iterator[list[Mention]]:
    """Yield the mentions as they are, then with neighbours joined in every possible way."""
    joints = [
        at for at in range(len(mentions) - 1) if _joined(tokens, mentions[at], mentions[at + 1]) is not None
    ][:_MOST_JOINTS]
    for size in range(len(joints) + 1):
        for chosen in itertools.combinations(joints, size):
            yield _with_joints(tokens, mentions, chosen)


def _with_joints(tokens: Words, mentions: Sequence[Mention], joints: Sequence[int]) -> list[Mention]:
    found: list[Mention] = []
    for at, mention in enumerate(mentions):
        joined = _joined(tokens, found[-1], mention) if at - 1 in joints else None
        if joined is None:
            found.append(mention)
        else:
            found[-1] = joined
    return found


def _joined(tokens: Words, one: Mention, other: Mention) -> Mention | None:
    """Return both mentions as one; None if they are neither a list nor an object at its present place."""
    between = tokens[one.end : other.start]
    if one.is_pronoun or other.is_pronoun:
        return None
    if between in _LISTED:
        return Mention(one.start, other.end, one.rows + other.rows, parts=(*one.each, *other.each))
    relation = _RELATIONS.get(between[-1]) if 0 < len(between) <= _MOST_BETWEEN else None
    hosts = {row.name for row in other.rows}
    there = tuple(row for row in one.rows if row.relation is relation and row.host in hosts)
    if relation is None or not there or one.parts or not all(map(str.isalnum, between)):
        return None
    return Mention(one.start, other.end, there, one.count)
