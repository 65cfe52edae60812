"""Diversity of instructions and goals without a judge: n-grams, entropies, near-duplicates, named people.

All figures depend on the number of instructions (self-BLEU grows with it): compare sets of equal size.
"""

import math
import re
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import Final

from embomatrix.scripts.similarity import TermIndex, Words, cosine, ngrams, words_in

NEAR: Final = 0.9
"""Cosine similarity above which two instructions are near-duplicates."""
SMOOTHING: Final = 0.1
"""Replacement for n-gram counts of 0: method 1 of Chen and Cherry (2014)."""


def distinct(texts: Sequence[Words], n: int) -> float:
    """Return the share of distinct n-grams (Li et al. 2016); 0 without n-grams."""
    grams = [gram for words in texts for gram in ngrams(words, n)]
    return len(set(grams)) / len(grams) if grams else 0.0


def self_bleu(texts: Sequence[Words], n: int = 4) -> float:
    """Return the mean BLEU of each text against all others (Zhu et al. 2018): 1 for copies, near 0 for unrelated texts."""
    if len(texts) < 2:
        return 0.0
    scores = [
        bleu(words, [other for at, other in enumerate(texts) if at != number], n)
        for number, words in enumerate(texts)
    ]
    return sum(scores) / len(scores)


def bleu(words: Words, references: Sequence[Words], n: int = 4) -> float:
    """Return the geometric mean of clipped 1- to n-gram precisions with the brevity penalty (Papineni et al. 2002)."""
    logs = []
    for size in range(1, n + 1):
        counts = Counter(ngrams(words, size))
        if not counts:
            break
        most: Counter[Words] = Counter()
        for reference in references:
            most |= Counter(ngrams(reference, size))
        matched = sum(min(count, most[gram]) for gram, count in counts.items())
        logs.append(math.log((matched or SMOOTHING) / counts.total()))
    if not logs:
        return 0.0
    nearest = min(
        (len(reference) for reference in references), key=lambda size: (abs(size - len(words)), size)
    )
    penalty = min(0.0, 1.0 - nearest / len(words))
    return math.exp(penalty + sum(logs) / len(logs))


def normalised_entropy(values: Collection[Hashable]) -> float:
    """Return the Shannon entropy of the values' frequencies as a share of its maximum, the log of their number."""
    if len(values) < 2:
        return 0.0
    shares = [count / len(values) for count in Counter(values).values()]
    return -sum(share * math.log(share) for share in shares) / math.log(len(values))


def near_duplicates(texts: Sequence[Words], near: float = NEAR) -> float:
    """Return the share of texts similar to an earlier one, by the cosine of TF-IDF weights of words and word pairs."""
    vectors = TermIndex(texts).vectors
    copies = sum(
        any(cosine(vector, earlier) > near for earlier in vectors[:number])
        for number, vector in enumerate(vectors)
    )
    return copies / len(texts) if texts else 0.0


def named_share(texts: Iterable[str], names: Collection[str]) -> float:
    """Return the share of texts that contain one of the names."""
    known = re.compile(rf"\b(?:{'|'.join(map(re.escape, names))})\b") if names else None
    found = [bool(known and known.search(text)) for text in texts]
    return sum(found) / len(found) if found else 0.0


def diversity(
    instructions: Mapping[str, Sequence[str]], signatures: Sequence[str], names: Collection[str]
) -> dict[str, float]:
    """Measure instructions by base scene. ``signatures`` are the goals' kinds, ``names`` are people's names.

    Figures are means over the scenes, except those of names, signatures, verbs and words, which are over all tasks.
    """
    groups = [[words_in(text) for text in texts] for texts in instructions.values() if texts]
    texts = [text for found in instructions.values() for text in found]
    every = [words for group in groups for words in group]
    return {
        "self_bleu4": _mean([self_bleu(group) for group in groups]),
        "distinct_1": _mean([distinct(group, 1) for group in groups]),
        "distinct_2": _mean([distinct(group, 2) for group in groups]),
        "near_duplicate_rate": _mean([near_duplicates(group) for group in groups]),
        "named_share": named_share(texts, names),
        "signature_entropy": normalised_entropy(signatures),
        "verb_entropy": normalised_entropy([words[0] for words in every if words]),
        "words": _mean([len(words) for words in every]),
    }


def _mean(values: Sequence[float]) -> float:
    return float(sum(values) / len(values)) if values else 0.0
