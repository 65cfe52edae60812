"""Word-level vocabulary. Small policies learn to copy words in minutes, subword tokens in hours.

It holds skills, relations, states, the category words of the object tables, room types, small numbers, and the frequent
words of the *training* instructions. ``apple_12`` is two tokens, ``apple`` and ``_12``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from embomatrix.skills.episode_text import OBSERVATION_WORDS
from embomatrix.skills.prompt import ABSENT, Situation
from embomatrix.skills.syntax import PROFILES, SIGNATURES, PlaceRelation
from embomatrix.world.state import State
from embomatrix.world.substances import WORDS as SUBSTANCE_WORDS
from embomatrix.world.task import Profile

PAD: Final = 0
END: Final = 1
GO: Final = 2
UNKNOWN: Final = 3
SPECIAL: Final = ("<pad>", "<end>", "<go>", "<unknown>")
BREAK: Final = "\n"
_NUMBERED: Final = re.compile(r"(.+?)(_\d+)")
_WORD: Final = re.compile(r"\n|-?\d+\.\d+|[a-z0-9_]+(?:-[a-z][a-z0-9_]*)*|-\d+")
_NUMBER: Final = re.compile(r"_\d+")
_QUANTITY: Final = re.compile(r"-?\d+(?:\.\d+)?")
_LONGEST_PHRASE: Final = 4
_ARGUMENT_COUNTS: Final[Mapping[str, int]] = {
    skill.value: len(arguments) for skill, arguments in SIGNATURES.items()
}
_SUBSTANCE_STATES: Final = tuple(f"{words.replace(' ', '_')}_" for words in SUBSTANCE_WORDS.values())
_WATER: Final = "water"
_MIN_COUNT: Final = 2
"""Occurrences of a word in the instructions that make it part of the vocabulary."""
_FIXED_WORDS: Final = (
    BREAK,
    *(skill.value for skill in PROFILES[Profile.PAPER]),
    *(relation.value for relation in PlaceRelation),
    *(state.value for state in State),
    *("room", "robot", "task", "in", "on", "under", "off", "open", "closed", "and", "then", "the", "it"),
    *("0", "0.5", "1", "1.57", "-1.57", "2", "3.14"),
)


def build_vocabulary(
    situations: Iterable[Situation], instructions: Iterable[str], *, in_episodes: bool = False
) -> Vocabulary:
    """Build the vocabulary of tasks from the object tables in ``situations`` and the training ``instructions``.

    With ``in_episodes`` it has the words of observations and all rooms of the scenes too.
    """
    known = tuple(situations)
    words: dict[str, None] = dict.fromkeys((*_FIXED_WORDS, *(_told_words(known) if in_episodes else ())))
    object_stems: dict[str, None] = {}
    room_stems: dict[str, None] = {}
    numbers = {0}
    for situation in known:
        words |= dict.fromkeys(skill.value for skill in PROFILES[situation.profile])
        words |= dict.fromkeys(state for row in situation.rows for state in row.states)
        object_stems |= dict.fromkeys(row.category for row in situation.rows)
        for stems, names in (
            (object_stems, [row.name for row in situation.rows]),
            (room_stems, situation.home if in_episodes else situation.rooms),
        ):
            for name in names:
                stem, number = _split_number(name)
                stems.setdefault(stem)
                numbers |= {int(number[1:])} if number else set()
    counts = Counter(word for text in instructions for word in _WORD.findall(text.lower()))
    frequent = sorted(word for word, count in counts.items() if count >= _MIN_COUNT)
    named = object_stems | room_stems
    # living_room_0 in an instruction must get the same tokens as in the table: a stem and a number.
    words |= dict.fromkeys(word for word in frequent if _split_number(word)[0] not in named)
    words |= named
    words |= dict.fromkeys(f"_{number}" for number in range(max(numbers) + 1))
    return Vocabulary((*SPECIAL, *words), tuple(object_stems), tuple(room_stems))


def _told_words(situations: Iterable[Situation]) -> tuple[str, ...]:
    """Return the words of observations, besides those of prompts: of outcomes, and of states that calls may lead to."""
    words = dict.fromkeys((*OBSERVATION_WORDS, ABSENT))
    substances = dict.fromkeys((_WATER,))
    for situation in situations:
        states = (state for row in situation.rows for state in row.states)
        substances |= dict.fromkeys(
            state.removeprefix(start)
            for state in states
            for start in _SUBSTANCE_STATES
            if state.startswith(start)
        )
    words |= dict.fromkeys(f"{start}{name}" for start in _SUBSTANCE_STATES for name in substances)
    return tuple(words)


def _split_number(name: str) -> tuple[str, str]:
    match = _NUMBERED.fullmatch(name)
    return (match[1], match[2]) if match else (name, "")


@dataclass(frozen=True)
class Vocabulary:
    """Words by token id. Unknown words become ``<unknown>``; decoding never fails.

    ``object_words`` and ``room_words`` are the first words of names in the object table and of rooms.
    """

    words: tuple[str, ...]
    object_words: tuple[str, ...]
    room_words: tuple[str, ...]
    index: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "index", {word: token for token, word in enumerate(self.words)})

    @property
    def object_tokens(self) -> tuple[int, ...]:
        return tuple(self.index[word] for word in self.object_words)

    @property
    def room_tokens(self) -> tuple[int, ...]:
        return tuple(self.index[word] for word in self.room_words)

    @property
    def number_tokens(self) -> tuple[int, ...]:
        """Words that end a name: ``_0``, ``_1`` and so on."""
        return tuple(token for token, word in enumerate(self.words) if _NUMBER.fullmatch(word))

    @property
    def quantity_tokens(self) -> tuple[int, ...]:
        """Words for angles and distances."""
        return tuple(token for token, word in enumerate(self.words) if _QUANTITY.fullmatch(word))

    def __len__(self) -> int:
        return len(self.words)

    def encode(self, text: str) -> list[int]:
        """Encode a text. The longest known phrase of up to four words wins, so "chicken leg" is one token."""
        words = _WORD.findall(text.lower())
        tokens: list[int] = []
        at = 0
        while at < len(words):
            length, found = self._longest(words[at : at + _LONGEST_PHRASE])
            tokens += found
            at += length
        return tokens

    def _longest(self, words: Sequence[str]) -> tuple[int, list[int]]:
        for size in range(len(words), 1, -1):
            phrase = "_".join(words[:size])
            if BREAK not in words[:size] and phrase in self.index:
                return size, [self.index[phrase]]
        return 1, self._word(words[0])

    def _word(self, word: str) -> list[int]:
        if word in self.index:
            return [self.index[word]]
        stem, number = _split_number(word)
        if number and stem in self.index and number in self.index:
            return [self.index[stem], self.index[number]]
        singular = word.removesuffix("s")
        return [self.index.get(singular, UNKNOWN)]

    def unknown_words(self, text: str) -> frozenset[str]:
        """Return the words of a text that become ``<unknown>``."""
        if UNKNOWN not in self.encode(text):
            return frozenset()
        return frozenset(word for word in _WORD.findall(text.lower()) if UNKNOWN in self._word(word))

    def encode_plan(self, text: str) -> list[int]:
        """Encode a plan. Its line breaks are left out, because each call ends with its last argument."""
        return [token for token in self.encode(text) if token != self.index[BREAK]]

    def decode_plan(self, tokens: Iterable[int]) -> str:
        """Decode a plan up to the end token, one call a line. Numbers join the word before: ``apple`` ``_2`` is ``apple_2``."""
        lines: list[str] = []
        missing = 0  # arguments of the last call
        for token in tokens:
            if token == END:
                break
            word = self.words[token]
            if lines and word.startswith("_"):
                lines[-1] += word
            elif lines and (missing or word not in _ARGUMENT_COUNTS):
                lines[-1] += f" {word}"
                missing = max(0, missing - 1)
            else:
                lines.append(word)
                missing = _ARGUMENT_COUNTS.get(word, 0)
        return "\n".join(lines)
