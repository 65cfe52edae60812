"""Reading of an instruction: its words, its nouns, and the relations that its prepositions state."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.social.rules.nouns import Mention, mentions_in, tokens_of
from embomatrix.factory.social.rules.vocabulary import ACTIONS
from embomatrix.factory.social.wish import PLACED, WishPredicate

NOUN: Final = "object"
"""Word that stands for a noun in the plain text."""
NUMBERS: Final = {
    word: number
    for number, word in enumerate(("one", "two", "three", "four", "five", "six", "seven", "eight"), start=1)
}
UNIVERSAL: Final = frozenset({"all", "every", "each", "both", "everything"})
INDEFINITE: Final = frozenset({"a", "an", "any", "some", "one", "another"})
_RELATIONS: Final = {
    "on": WishPredicate.ONTOP,
    "onto": WishPredicate.ONTOP,
    "upon": WishPredicate.ONTOP,
    "atop": WishPredicate.ONTOP,
    "to": WishPredicate.ONTOP,
    "in": WishPredicate.INSIDE,
    "into": WishPredicate.INSIDE,
    "inside": WishPredicate.INSIDE,
    "within": WishPredicate.INSIDE,
    "under": WishPredicate.UNDER,
    "underneath": WishPredicate.UNDER,
    "beneath": WishPredicate.UNDER,
    "below": WishPredicate.UNDER,
    "beside": WishPredicate.NEXTTO,
    "by": WishPredicate.NEXTTO,
    "near": WishPredicate.NEXTTO,
    "alongside": WishPredicate.NEXTTO,
    "next": WishPredicate.NEXTTO,
    "close": WishPredicate.NEXTTO,
}
"""Relation that a preposition states."""
_DEPARTURES: Final = {
    "off": (WishPredicate.ONTOP,),
    "out": (WishPredicate.INSIDE,),
    "from": tuple(sorted(PLACED)),
}
"""Relations that end according to a preposition."""
_PRONOUNS: Final = frozenset({"it", "them", "there", "one"})
_REACH: Final = 6
"""Words between a preposition and the noun of its place."""
_JOINT: Final = 2
"""Words between two joined nouns: *or the*."""
_STOPS: Final = frozenset(
    (*".,;:!?", "and", "then", "or", "but", "put", "is", "are", "open", "that", "which")
)
_ENDS: Final = frozenset(".;!?")
_CLAUSE_ENDS: Final = frozenset((*".,;:!?", "and", "then", "but"))
_ACTION: Final = re.compile(rf"\b(?:{ACTIONS})\b")
_ASIDE: Final = (
    (re.compile(r"\ball over\b"), "over"),
    (re.compile(r"\bfrom (?:under|underneath|beneath|below|behind|inside)\b"), "from"),
    (re.compile(r"\b(?:hanging|standing|wide) open\b"), "open"),
    (re.compile(r" to (?:cook|eat|drink|read|write|sit|play) (?:in|with|from|on)\b"), ""),
    (re.compile(r"\bgo(?:es)? off\b"), "spoil"),
    (
        re.compile(
            r"\ba (?:good |quick |thorough |proper )?(?:clean|wash|wipe|scrub)(?=[.,;:!?]| and| for| please|$)"
        ),
        "cleaning",
    ),
)
"""Phrases whose words state no quantity, place or demand, with what remains of them."""
_ASKS: Final = re.compile(
    r"\b(?:please|could|can|would|will|wants?|needs?|likes?|asks?|must|should|shall|has to|have to|make sure|see|belongs?)\b"
)
_REASONS: Final = re.compile(
    r"[^.,;:!?]+(?= , so\b)|"
    r"\bto (?:have|drink|eat|enjoy|read|start|begin)\b[^.,;:!?]*|"
    r"\b(?:because|since|so that|so|as (?:she|he|they|it)|before|after|while|whenever|when|for|in case|until)\b[^.,;:!?]*"
)
"""Clause with the reason or the time of a request."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Read instruction. ``plain`` is its lower-case text with each noun replaced by ``NOUN``."""

    text: str
    tokens: tuple[str, ...]
    mentions: tuple[Mention, ...]
    plain: str

    def before(self, mention: Mention, words: int) -> tuple[str, ...]:
        """Return up to this many words before the noun, not beyond a stop of the clause."""
        found: list[str] = []
        for at in range(mention.start - 1, -1, -1):
            token = self.tokens[at]
            # *Into the open drawer* goes on, *is open, the drawer* ends.
            is_adjective = token == "open" and at > 0 and self.tokens[at - 1] in ("the", "a", "an")
            if (token in _STOPS and not is_adjective) or len(found) == words:
                break
            found.insert(0, token)
        return tuple(found)

    def relations_to(self, mentions: Sequence[Mention]) -> Iterator[WishPredicate]:
        """Yield the relations that prepositions state to one of these nouns, or to a pronoun that follows one."""
        for mention in mentions:
            yield from _relations(self._governing(mention))
        first = min((mention.start for mention in mentions), default=len(self.tokens))
        for at in range(first, len(self.tokens)):
            if self.tokens[at] in _PRONOUNS:
                yield from _relations(self.tokens[max(0, at - 3) : at])
        if any(token == "inside" for token in self.tokens[first:]):
            yield WishPredicate.INSIDE

    def departures_from(self, mentions: Sequence[Mention]) -> Iterator[WishPredicate]:
        """Yield the relations to one of these nouns that shall end: *off the sofa*, *out of the box*."""
        for mention in mentions:
            words = [word for word in self._governing(mention) if word in _DEPARTURES]
            if words:
                yield from _DEPARTURES[words[-1]]

    def _governing(self, mention: Mention) -> tuple[str, ...]:
        """Return the words before the noun, or before the one that it is joined to: *on the sofa or the bed*."""
        words = self.before(mention, _REACH)
        for other in self.mentions:
            joint = self.tokens[other.end : mention.start]
            is_joined = bool(joint) and len(joint) <= _JOINT and joint[0] in ("or", "and")
            if is_joined and not any(word in _RELATIONS for word in joint):
                return self._governing(other)
        return words

    def clause_before(self, mention: Mention) -> str:
        """Return the words of the noun's clause that come before it."""
        at = mention.start
        while at and self.tokens[at - 1] not in _CLAUSE_ENDS:
            at -= 1
        return " ".join(self.tokens[at : mention.start])

    def has_reason_at(self, mention: Mention) -> bool:
        """True if the noun is part of a clause or sentence with the reason or the time of the request."""
        start = max((at + 1 for at in range(mention.start) if self.tokens[at] in _ENDS), default=0)
        ends = (at for at in range(mention.end, len(self.tokens)) if self.tokens[at] in _ENDS)
        sentence = " ".join(self.tokens[start : next(ends, len(self.tokens))])
        if not (_ACTION.search(sentence) or _ASKS.search(sentence)):
            return True
        text = " ".join(self.tokens)
        at = len(" ".join(self.tokens[: mention.start]))
        reasons = (match for match in _REASONS.finditer(text) if not _ACTION.search(match.group()))
        return any(match.start() <= at < match.end() for match in reasons)


def read(text: str, context: Sequence[str] = ()) -> Reading:
    """Read an instruction. Phrases of the ``context``, such as a person's job, state no demand and name no object."""
    lowered = text.lower()
    for phrase in sorted(filter(None, context), key=len, reverse=True):
        lowered = re.sub(rf"\b{re.escape(phrase.lower())}\b", "context", lowered)
    for aside, left in _ASIDE:
        lowered = aside.sub(left, lowered)
    tokens = tokens_of(lowered)
    mentions = mentions_in(tokens)
    return Reading(text, tokens, mentions, _plain(tokens, mentions))


def _plain(tokens: tuple[str, ...], mentions: tuple[Mention, ...]) -> str:
    words: list[str] = []
    at = 0
    for mention in mentions:
        # A single word without a determiner may be a verb: toast, dust.
        is_noun = mention.end - mention.start > 1 or _follows_determiner(tokens, mention) or mention.is_plural
        words += tokens[at : mention.start]
        words += [NOUN] if is_noun else tokens[mention.start : mention.end]
        at = mention.end
    return " ".join((*words, *tokens[at:]))


def _follows_determiner(tokens: tuple[str, ...], mention: Mention) -> bool:
    before = tokens[mention.start - 1] if mention.start else ""
    words = (
        UNIVERSAL
        | INDEFINITE
        | set(NUMBERS)
        | {"the", "my", "his", "her", "our", "their", "this", "that", "no"}
    )
    return before in words or before.endswith(("'s", "’s"))


def _relations(words: Sequence[str]) -> Iterator[WishPredicate]:
    """Yield the relation of the last preposition among the words; none if it says that a relation ends."""
    for at in range(len(words) - 1, -1, -1):
        word = words[at]
        if word in _DEPARTURES:
            return
        if word not in _RELATIONS:
            continue
        previous = words[at - 1] if at else ""
        if word == "to" and previous in ("next", "close"):
            word = "next"
        yield _RELATIONS[word]
        if word == "to":
            yield WishPredicate.INSIDE
        return
