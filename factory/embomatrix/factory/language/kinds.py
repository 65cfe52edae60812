"""Words for kinds of things, such as *fruit* or *something to drink from*, with the categories that they cover.

The table is ``kinds.toml`` beside this module.
"""

import functools
import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Final

from embomatrix.factory.language.nouns import Noun

FILE: Final = "kinds.toml"
HELD_OUT_KINDS: Final = 5
"""One in this many kinds belongs to the held-out split."""


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of things with its noun and the categories of its members.

    ``use`` says what one of them is for, such as *something to drink from*; empty for a kind without such words.
    """

    name: str
    noun: Noun
    members: frozenset[str]
    use: str = ""
    several: bool = False
    """True if the noun is natural only for several things, as *things to read* is and *the thing to read* is not."""


@functools.cache
def kinds() -> Mapping[str, Kind]:
    """Return all kinds by name."""
    text = (resources.files("embomatrix.factory.language") / FILE).read_text(encoding="utf-8")
    return {
        name: Kind(
            name,
            Noun(entry["one"], entry["many"]),
            frozenset(entry["members"]),
            entry.get("use", ""),
            entry.get("several", False),
        )
        for name, entry in tomllib.loads(text).items()
    }


@functools.cache
def kinds_with(categories: frozenset[str]) -> tuple[Kind, ...]:
    """Return the kinds that cover all these categories, the narrowest first."""
    found = [kind for kind in kinds().values() if categories <= kind.members]
    return tuple(sorted(found, key=lambda kind: len(kind.members)))


def is_held_out(words: str, seed: int, one_of: int) -> bool:
    """True if these words are kept for the held-out split: a hash draw of one in ``one_of``, fixed for a seed."""
    return hashlib.sha256(f"{seed} {words}".encode()).digest()[0] % one_of == 0
