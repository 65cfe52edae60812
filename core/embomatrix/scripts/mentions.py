"""Mentions: noun phrases of an instruction, and the rows of the object table that they may denote."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from embomatrix.scripts.examples import ScriptExample
from embomatrix.scripts.similarity import Words
from embomatrix.skills.prompt import PromptRow, Situation

_TOKEN: Final = re.compile(r"[a-z0-9]+(?:'[a-z]+)?|[.,;:!?()]")
PRONOUNS: Final = frozenset({"it", "them"})
SEPARATORS: Final = frozenset({*".,;:!?()", "and", "then", "so", "but", "while"})
"""Tokens that end a clause, unless they stand between two mentions of it."""
_NUMBERS: Final[Mapping[str, int]] = {"two": 2, "three": 3, "four": 4, "five": 5, "six": 6}
_EVERY: Final = frozenset({"all", "each", "every", "both"})
_ARTICLES: Final = frozenset(
    {
        "the",
        "a",
        "an",
        "any",
        "one",
        "some",
        "of",
        "my",
        "our",
        "his",
        "her",
        "their",
        "your",
        "this",
        "these",
        "those",
    }
)
_DETERMINERS: Final = _ARTICLES - {"of", "one"} | _EVERY | _NUMBERS.keys()
_BEFORE_ROOM: Final = frozenset({"in", "from", "of", "into", "at", "inside", "to"})
_MOST_BETWEEN: Final = 3
"""Words between an object and the room that it is said to be in: ``over there in``."""
_LONGEST_NAME: Final = 4
_LEAST_PRECISION: Final = 0.8
"""Share of the uses of a phrase that must mean one category before it is taken for its everyday name."""

RoomSpan = tuple[int, int, tuple[str, ...]]
"""First token of a room's name, the token after its last one, and the rooms that it fits."""


@dataclass(frozen=True, slots=True)
class Mention:
    """Noun phrase: its tokens ``start`` to ``end``, and the rows that fit its words. Pronouns have no rows.

    ``count`` is the number of objects that it denotes; 0 means all that fit. ``parts`` are the members of a list.
    """

    start: int
    end: int
    rows: tuple[PromptRow, ...] = ()
    count: int = 1
    parts: tuple[Mention, ...] = ()

    @property
    def each(self) -> tuple[Mention, ...]:
        """The members of a list, or the mention itself."""
        return self.parts or (self,)

    @property
    def is_pronoun(self) -> bool:
        return not self.rows


def tokens_of(text: str) -> Words:
    """Return lower-case words and punctuation marks; underscores and hyphens separate words."""
    return tuple(_TOKEN.findall(text.lower().replace("_", " ").replace("-", " ")))


@dataclass(frozen=True, slots=True)
class Lexicon:
    """Everyday names of categories, as tokens. A category's own name is always known."""

    names: Mapping[str, tuple[Words, ...]]

    @staticmethod
    def learned(examples: Iterable[ScriptExample]) -> Lexicon:
        """Learn the everyday names of a training split.

        A phrase after an article that no category's name explains is the name of a demanded category that is not named.
        """
        plain = Lexicon({})
        uses: Counter[Words] = Counter()
        together: dict[str, Counter[Words]] = {}
        for example in examples:
            tokens = tokens_of(example.situation.instruction)
            mentions = list(plain.named(tokens, example.situation))
            covered = {at for mention in mentions for at in range(mention.start, mention.end)}
            phrases = set(_phrases(tokens, covered))
            uses.update(phrases)
            named = {row.category for mention in mentions for row in mention.rows}
            for category in example.demanded - named:
                together.setdefault(category, Counter()).update(phrases)
        names = {}
        for category, counted in together.items():
            sure = [
                phrase
                for phrase, count in counted.items()
                if count >= max(2, _LEAST_PRECISION * uses[phrase])
            ]
            if sure:
                names[category] = (max(sure, key=lambda phrase: (counted[phrase], len(phrase), phrase)),)
        return Lexicon(names)

    def mentions(self, tokens: Words, situation: Situation) -> list[Mention]:
        """Return the mentions of a tokenised instruction, in order."""
        rooms = _rooms(tokens, situation)
        taken = {at for start, end, _ in rooms for at in range(start, end)}
        found = list(self.named(tokens, situation, taken))
        taken.update(at for mention in found for at in range(mention.start, mention.end))
        found += _by_head(tokens, situation, taken)
        found += _pronouns(tokens, min((mention.start for mention in found), default=len(tokens)))
        found.sort(key=lambda mention: mention.start)
        return [_with_room(_with_determiner(mention, tokens), found, rooms, tokens) for mention in found]

    def named(
        self, tokens: Words, situation: Situation, taken: Collection[int] = frozenset()
    ) -> Iterator[Mention]:
        """Yield the mentions of known names, the longest at each place. ``taken`` tokens belong to none."""
        by_category = _by_category(situation)
        known: dict[Words, list[PromptRow]] = {}
        for category, rows in by_category.items():
            for name in dict.fromkeys((*_own_names(category), *self.names.get(category, ()))):
                known.setdefault(name, []).extend(rows)
        longest = max(map(len, known), default=0)
        at = 0
        while at < len(tokens):
            for size in range(min(longest, len(tokens) - at), 0, -1):
                span = tokens[at : at + size]
                names = [name for name in known if len(name) == size and is_form_of(span, name)]
                if names and not any(place in taken for place in range(at, at + size)):
                    yield Mention(
                        at,
                        at + size,
                        tuple(row for name in names for row in known[name]),
                        1 if span in names else 0,
                    )
                    at += size
                    break
            else:
                at += 1


def _phrases(tokens: Words, covered: set[int]) -> Iterator[Words]:
    """Yield word sequences after an article that no mention covers."""
    for at, token in enumerate(tokens[:-1]):
        if token not in _ARTICLES:
            continue
        for end in range(at + 2, min(at + 2 + _LONGEST_NAME, len(tokens) + 1)):
            if end - 1 in covered or not tokens[end - 1].isalnum():
                break
            yield tokens[at + 1 : end]


def is_form_of(words: Words, name: Words) -> bool:
    """Return True if the words are a name, or its plural."""
    if words == name:
        return True
    if words[:-1] != name[:-1]:
        return False
    noun = name[-1]
    plurals = {f"{noun}s", f"{noun}es", f"{noun[:-1]}ies", f"{noun[:-1]}ves", f"{noun[:-2]}ves"}
    return words[-1] in plurals


def _own_names(category: str) -> list[Words]:
    """Return a category's words, and their ends of two words or more: ``kitchen shelf`` for ``commercial_kitchen_shelf``."""
    words = tuple(category.split("_"))
    return [words, *(words[at:] for at in range(1, len(words) - 1))]


def _by_category(situation: Situation) -> dict[str, list[PromptRow]]:
    found: dict[str, list[PromptRow]] = {}
    for row in situation.rows:
        found.setdefault(row.category, []).append(row)
    return found


def _by_head(tokens: Words, situation: Situation, taken: set[int]) -> Iterator[Mention]:
    """Yield phrases after an article that end with the last word of a category, as ``the sink`` for ``pedestal_sink``."""
    heads: dict[str, list[PromptRow]] = {}
    for row in situation.rows:
        heads.setdefault(row.category.split("_")[-1], []).append(row)
    for at, token in enumerate(tokens):
        rows = [row for head, alike in heads.items() if is_form_of((token,), (head,)) for row in alike]
        start = at
        while start > 0 and at - start < _LONGEST_NAME and tokens[start - 1] not in _DETERMINERS:
            start -= 1
        whole = not any(place in taken for place in range(start - 1, at + 1))
        if rows and whole and start > 0 and tokens[start - 1] in _DETERMINERS:
            yield Mention(start, at + 1, tuple(rows), 1 if token in heads else 0)


def _pronouns(tokens: Words, first: int) -> Iterator[Mention]:
    """Yield the pronouns after the first object. ``it that`` announces a clause and denotes no object."""
    for at, token in enumerate(tokens):
        if token in PRONOUNS and at > first and tokens[at + 1 : at + 2] != ("that",):
            yield Mention(at, at + 1)


def _with_determiner(mention: Mention, tokens: Words) -> Mention:
    """Extend a mention over its articles and numbers, and set its count."""
    start, count = mention.start, mention.count
    while start > 0 and not mention.is_pronoun:
        word = tokens[start - 1]
        if word in _EVERY:
            count = 0
        elif word in _NUMBERS:
            count = _NUMBERS[word]
        elif word not in _ARTICLES:
            break
        start -= 1
    while start < mention.start and tokens[start] == "of":
        start += 1
    return replace(mention, start=start, count=count)


def _rooms(tokens: Words, situation: Situation) -> list[RoomSpan]:
    """Return the spans that name rooms after a preposition, each with the rooms that it fits."""
    called: dict[Words, list[str]] = {}
    for room in dict.fromkeys((*situation.rooms, *(row.room for row in situation.rows))):
        words = tokens_of(room)
        called.setdefault(words, []).append(room)
        if words and words[-1].isdigit():
            called.setdefault(words[:-1], []).append(room)
    found: list[RoomSpan] = []
    at = 0
    while at < len(tokens):
        if tokens[at] == "there" and found:
            found.append((at, at + 1, found[-1][2]))
        size = next((size for size in range(_LONGEST_NAME, 0, -1) if tokens[at : at + size] in called), 0)
        before = tokens[at - 2] if at > 1 and tokens[at - 1] in _ARTICLES else tokens[at - 1] if at else ""
        if size and before in _BEFORE_ROOM:
            found.append((at, at + size, tuple(called[tokens[at : at + size]])))
        at += max(size, 1)
    return found


def _with_room(
    mention: Mention,
    mentions: Sequence[Mention],
    rooms: Sequence[RoomSpan],
    tokens: Words,
) -> Mention:
    """Extend a mention over the room that follows it, and keep the rows of that room."""
    following = next((room for room in rooms if room[0] >= mention.end), None)
    if following is None or mention.is_pronoun:
        return mention
    start, end, named = following
    between = [token for token in tokens[mention.end : start] if token not in _ARTICLES]
    apart = any(mention.end <= other.start < start for other in mentions)
    if apart or len(between) > _MOST_BETWEEN or SEPARATORS.intersection(between):
        return mention
    rows = tuple(row for row in mention.rows if row.room in named)
    return replace(mention, end=end, rows=rows or mention.rows)
