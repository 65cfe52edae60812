"""Similarity of texts: cosine of TF-IDF weights of words and word pairs."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

_WORD: Final = re.compile(r"[a-z0-9]+(?:'[a-z]+)?")

Words = tuple[str, ...]


def words_in(text: str) -> Words:
    """Return lower-case words; underscores separate words."""
    return tuple(_WORD.findall(text.lower().replace("_", " ")))


def ngrams(words: Words, n: int) -> list[Words]:
    """Return the n-grams of a text in order."""
    return [words[at : at + n] for at in range(len(words) - n + 1)]


class TermIndex:
    """Texts with the TF-IDF weights of their words and word pairs, in the given order."""

    def __init__(self, texts: Sequence[Words]) -> None:
        counts = [_counts(words) for words in texts]
        seen = Counter(gram for count in counts for gram in count)
        self._rarity = {gram: _rarity(len(texts), number) for gram, number in seen.items()}
        self._rarest = _rarity(len(texts), 0)
        self.vectors = [self._weighted(count) for count in counts]

    def ranked(self, words: Words) -> list[int]:
        """Return the positions of all texts, the most similar first and equal ones in order."""
        vector = self._weighted(_counts(words))
        scores = [cosine(vector, other) for other in self.vectors]
        return sorted(range(len(scores)), key=lambda at: -scores[at])

    def _weighted(self, count: Mapping[Words, int]) -> dict[Words, float]:
        return {gram: number * self._rarity.get(gram, self._rarest) for gram, number in count.items()}


def cosine(one: Mapping[Words, float], other: Mapping[Words, float]) -> float:
    """Return the cosine of two vectors; 0 if one is empty."""
    shared = sum(weight * other.get(gram, 0.0) for gram, weight in one.items())
    length = math.sqrt(sum(w * w for w in one.values()) * sum(w * w for w in other.values()))
    return shared / length if length else 0.0


def _counts(words: Words) -> Counter[Words]:
    return Counter([*ngrams(words, 1), *ngrams(words, 2)])


def _rarity(texts: int, number: int) -> float:
    return math.log((1 + texts) / (1 + number)) + 1
