"""Nouns for kinds of objects: names of the catalog, everyday names, head nouns, and hypernyms of the kind's synset."""

import functools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.language.nouns import everyday_noun
from embomatrix.world.bddl import ROOM_TYPES
from embomatrix.world.catalog import Catalog

LONGEST: Final = 5
"""Words of the longest noun."""
SENSES: Final = 6
"""Senses of a lemma that are looked up."""
ALSO_CALLED: Final[Mapping[str, str]] = {
    "couch": "sofa",
    "cupboard": "cabinet",
    "refrigerator": "fridge",
    "counter": "countertop",
    "worktop": "countertop",
    "bin": "trash can",
    "dustbin": "trash can",
    "garbage can": "trash can",
    "cooker": "stove",
    "hob": "stove",
    "plant": "pot plant",
    "telly": "tv",
    "television": "tv",
    "cup": "mug",
    "carpet": "rug",
    "tap": "sink",
    "basin": "sink",
    "phone": "cell phone",
    "drawer": "cabinet",
    "washing machine": "washer",
}
"""Nouns that people use for other nouns."""
TOO_GENERAL: Final = frozenset(
    (
        "thing", "object", "item", "entity", "whole", "matter", "artifact", "device", "article", "material",
        "substance", "part", "unit", "stuff", "piece", "container", "furniture", "furnishing", "equipment",
        "product", "creation", "instrumentality", "commodity", "structure", "covering", "solid", "ware", "machine",
        "implement", "appliance", "place", "one", "way", "end", "set", "rest", "surface", "support",
    )
)  # fmt: skip
"""Nouns that fit nearly every object."""
NOT_OBJECTS: Final = frozenset(
    (
        "can", "may", "will", "like", "well", "back", "top", "side", "front", "middle", "bottom", "light", "order",
        "use", "water", "minute", "second", "hand", "home", "house", "room", "family", "child", "cook", "watch",
        "iron", "cover", "match", "post", "present", "fan", "step", "square", "face", "cut", "slice", "half",
        "it", "up", "off", "stand", "door", "lid", "handle", "button", "switch",
        "meal", "dinner", "breakfast", "lunch", "supper", "background", "address", "air", "heat",
    )
)  # fmt: skip
"""Words that are names in the catalog but rarely the objects of a request."""
_DETERMINERS: Final = frozenset(
    (
        "the", "a", "an", "this", "these", "those", "my", "your", "his", "her", "our", "their", "its",
        "all", "both", "every", "each", "any", "some", "no", "another", "other", "of", "one", "two", "three",
        "four", "five", "six", "seven", "eight",
    )
)  # fmt: skip
_BREAKS: Final = frozenset({"that", "which", "who", "to", "will", "can", "may", "and"})
"""Words between a determiner and a verb that looks like a noun, as in *the cups that stand there*."""
WORD: Final = re.compile(r"[a-z0-9]+(?:['’][a-z]+)?|[.,;:!?]")
"""Word or punctuation mark of lower-case text."""


@dataclass(frozen=True, slots=True)
class Mention:
    """Noun in a text: its first token, the token after its last one, its singular, and whether it is a plural."""

    start: int
    end: int
    noun: str
    is_plural: bool


def tokens_of(text: str) -> tuple[str, ...]:
    """Return words and punctuation marks in lower case. A possessive ``'s`` belongs to its word."""
    return tuple(WORD.findall(text.lower()))


def mentions_in(tokens: tuple[str, ...]) -> tuple[Mention, ...]:
    """Return the nouns of the text that name objects, the longest at each place."""
    found, at = [], 0
    while at < len(tokens):
        mention = _mention_at(tokens, at)
        if mention is not None:
            found.append(mention)
            at = mention.end
        else:
            at += 1
    return tuple(found)


def _mention_at(tokens: tuple[str, ...], at: int) -> Mention | None:
    for length in range(min(LONGEST, len(tokens) - at), 0, -1):
        words = tokens[at : at + length]
        for last in singulars(words[-1]):
            noun = " ".join((*words[:-1], last))
            if noun.replace(" ", "_") in ROOM_TYPES and length > 1:
                return None
            if is_noun(noun):
                return Mention(at, at + length, noun, last != words[-1])
    return None


def is_noun(noun: str) -> bool:
    """True if the noun names objects of the catalog, or a class of them."""
    if noun in TOO_GENERAL:
        return False
    return bool(kinds_called(noun)) or bool(_synsets(noun))


@functools.cache
def kinds_called(noun: str) -> frozenset[str]:
    """Return the kinds that the noun names outright, not as a class. Empty for words that rarely mean objects."""
    return frozenset() if noun in NOT_OBJECTS else _index().get(noun, frozenset())


@functools.cache
def fits(noun: str, kind: str) -> bool:
    """True if people may use the noun for an object of the kind: its name, or a hypernym of its synset."""
    if noun in TOO_GENERAL:
        return False
    if noun in names_of(kind):
        return True
    place, _, rest = noun.partition(" ")
    if rest and place in ROOM_TYPES and fits(rest, kind):
        return True
    catalog = Catalog.load()
    if kind not in _kinds():
        return noun == kind
    return any(catalog.is_a(catalog.synset_of(kind), synset) for synset in _synsets(noun))


@functools.cache
def names_of(kind: str) -> frozenset[str]:
    """Return the names of a kind: in the catalog, in everyday life, their head nouns, and synonyms."""
    names = set(_full_names(kind))
    for name in tuple(names):
        first, of, rest = name.partition(" of ")
        names.update((first, rest, f"{rest} {first}") if of else (name.split()[-1],))
    names -= TOO_GENERAL
    names |= {called for called, other in ALSO_CALLED.items() if other in names}
    return frozenset(names)


def named(noun: str) -> str:
    """Return the kind with exactly this name, preferably the catalog's own and one in use; "" if there is none."""
    words = noun.strip().lower().replace("_", " ")
    if (own := words.replace(" ", "_")) in _kinds():
        return own
    found = sorted(
        kind
        for single in singulars(words)
        for kind in _index().get(single, ())
        if single in _full_names(kind)
    )
    used = [kind for kind in found if kind in Catalog.load().used_categories]
    return next(iter(used or found), "")


def singulars(word: str) -> Iterator[str]:
    """Yield the word and its possible singulars."""
    yield word
    stem = word.removesuffix("'s").removesuffix("’s")
    if stem != word:
        yield stem
    if word.endswith("ies"):
        yield word[:-3] + "y"
    if word.endswith("ves"):
        yield word[:-3] + "f"
        yield word[:-3] + "fe"
    if word.endswith("es"):
        yield word[:-2]
    if word.endswith("s") and not word.endswith("ss"):
        yield word[:-1]


def is_object_of_request(mention: Mention, tokens: tuple[str, ...]) -> bool:
    """True if the noun stands where an object of a request does: after a determiner, or in the plural."""
    before = tokens[max(0, mention.start - 3) : mention.start]
    for at, word in enumerate(before):
        if word in _BREAKS:
            before = before[at + 1 :]
            break
    determined = any(word in _DETERMINERS or word.endswith(("'s", "’s")) for word in before)
    return bool(kinds_called(mention.noun)) and (determined or mention.is_plural)


def _full_names(kind: str) -> tuple[str, str, str]:
    synset = Catalog.load().synset_of(kind) if kind in _kinds() else kind
    return kind.replace("_", " "), everyday_noun(kind).lower(), synset.partition(".")[0].replace("_", " ")


@functools.cache
def _kinds() -> frozenset[str]:
    return frozenset(Catalog.load().category_names)


@functools.cache
def _index() -> Mapping[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for kind in Catalog.load().category_names:
        for name in names_of(kind):
            found.setdefault(name, set()).add(kind)
    return {name: frozenset(kinds) for name, kinds in found.items()}


@functools.cache
def _synsets(noun: str) -> tuple[str, ...]:
    """Return the synsets of the catalog with this lemma."""
    if noun in TOO_GENERAL or noun in NOT_OBJECTS:
        return ()
    lemma = noun.replace(" ", "_")
    catalog = Catalog.load()
    names = (f"{lemma}.n.{number:02d}" for number in range(1, SENSES + 1))
    return tuple(name for name in names if catalog.has_synset(name))
