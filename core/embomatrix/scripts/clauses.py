"""Clause templates: the wording of demands with slots for the objects, learned from training instructions."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.scripts.mentions import SEPARATORS, Mention

if TYPE_CHECKING:
    from embomatrix.scripts.similarity import Words
    from embomatrix.world.intent import IntentClause

MOST_MENTIONS: Final = 4
"""Mentions of one clause."""
_MOST_WORDS: Final = 6
"""Words before the first mention of a clause and after its last one that belong to its wording."""

Word = tuple[int, str]
"""Word of a clause with the number of mentions before it."""


@dataclass(frozen=True, slots=True)
class ClauseMeaning:
    """Demand of a clause: a predicate of the mention ``thing``, and of the mention ``place`` if the clause names one."""

    predicate: str
    holds: bool
    thing: int
    place: int | None = None


@dataclass(frozen=True, slots=True)
class Clause:
    """Wording of a group of neighbouring mentions: the words around and between them, without punctuation."""

    mentions: int
    words: tuple[Word, ...]


@dataclass(frozen=True, slots=True)
class ReadClause:
    """Clause of an instruction with its meaning; ``first`` is its first mention."""

    first: int
    meaning: ClauseMeaning


def clause_of(tokens: Words, mentions: Sequence[Mention], first: int, last: int) -> Clause:
    """Return the wording of the mentions ``first`` to ``last``."""
    begin = mentions[first - 1].end if first else 0
    end = mentions[last + 1].start if last + 1 < len(mentions) else len(tokens)
    before: list[str] = []
    for token in reversed(tokens[begin : mentions[first].start]):
        if token in SEPARATORS or len(before) == _MOST_WORDS:
            break
        before.insert(0, token)
    after = list(itertools.takewhile(lambda token: token not in SEPARATORS, tokens[mentions[last].end : end]))
    gaps = [
        [token for token in tokens[one.end : other.start] if token.isalnum()]
        for one, other in itertools.pairwise(mentions[first : last + 1])
    ]
    words = [(at, word) for at, gap in enumerate([before, *gaps, after[:_MOST_WORDS]]) for word in gap]
    return Clause(last - first + 1, tuple(sorted(words)))


class ClauseTemplates:
    """Clauses of a training split with their meanings; None for a clause without a demand.

    Equal clauses are exact matches. Other clauses take the meaning of the template with the largest overlap in words, where a
    word counts as much as it tells about the meaning.
    """

    def __init__(self, examples: Sequence[tuple[Clause, ClauseMeaning | None]]) -> None:
        votes: dict[Clause, Counter[ClauseMeaning | None]] = defaultdict(Counter)
        for clause, meaning in examples:
            votes[clause][meaning] += 1
        self._meanings = {clause: counted.most_common(1)[0] for clause, counted in votes.items()}
        self._weights = _weights(examples)
        self._using: dict[tuple[int, Word], list[Clause]] = defaultdict(list)
        for clause in self._meanings:
            for word in set(clause.words):
                self._using[clause.mentions, word].append(clause)
        self._sizes = {clause: self._size(clause) for clause in self._meanings}

    def read(self, tokens: Words, mentions: Sequence[Mention]) -> tuple[float, list[ReadClause]]:
        """Split an instruction into clauses. Return the mean similarity and the clauses that demand something, in order.

        Of all divisions of the mentions into neighbouring groups, the one with the best matches is taken.
        """
        best: list[tuple[float, tuple[ReadClause, ...]]] = [(0.0, ())]
        for end in range(1, len(mentions) + 1):
            options = [best[end - 1]]  # a mention that no template explains
            for first in range(max(0, end - MOST_MENTIONS), end):
                score, meaning = self.match(clause_of(tokens, mentions, first, end - 1))
                found: tuple[ReadClause, ...] = () if meaning is None else (ReadClause(first, meaning),)
                before = best[first]
                score *= _WITHOUT_DEMAND if meaning is None else 1.0
                options.append((before[0] + score * (end - first), (*before[1], *found)))
            best.append(max(options, key=lambda option: option[0]))
        total, read = best[-1]
        return total / max(1, len(mentions)), list(read)

    def match(self, clause: Clause) -> tuple[float, ClauseMeaning | None]:
        """Return the similarity of the best template, from 0 to 1, and its meaning."""
        if clause in self._meanings:
            return 1.0, self._meanings[clause][0]
        shared: dict[Clause, float] = defaultdict(float)
        for word, count in Counter(clause.words).items():
            for template in self._using.get((clause.mentions, word), ()):
                shared[template] += self._weight(clause.mentions, word) * min(
                    count, template.words.count(word)
                )
        if not shared:
            return 0.0, None
        size = self._size(clause)
        scores = {template: 2 * found / (size + self._sizes[template]) for template, found in shared.items()}
        nearest = max(
            scores, key=lambda template: (scores[template], self._meanings[template][1], template.words)
        )
        return scores[nearest], self._meanings[nearest][0]

    def _weight(self, mentions: int, word: Word) -> float:
        return self._weights.get((mentions, word), _UNKNOWN)

    def _size(self, clause: Clause) -> float:
        return sum(self._weight(clause.mentions, word) for word in clause.words)


_WITHOUT_DEMAND: Final = 0.75
"""Factor on the similarity of a clause that demands nothing: in doubt, an instruction demands something."""
_UNKNOWN: Final = 0.3
"""Weight of a word that no template contains. The largest weight is 1."""
_LEAST: Final = 0.02
_SHRINK: Final = 2.0
"""Number of uses at which a word that tells everything about the meaning has half its weight."""


def _weights(examples: Sequence[tuple[Clause, ClauseMeaning | None]]) -> dict[tuple[int, Word], float]:
    """Weigh each word by the share of the meanings' entropy that its presence removes."""
    overall: dict[int, Counter[ClauseMeaning | None]] = defaultdict(Counter)
    by_word: dict[tuple[int, Word], Counter[ClauseMeaning | None]] = defaultdict(Counter)
    for clause, meaning in examples:
        overall[clause.mentions][meaning] += 1
        for word in set(clause.words):
            by_word[clause.mentions, word][meaning] += 1
    return {
        key: max(
            _LEAST,
            (1 - _entropy(counted) / (_entropy(overall[key[0]]) or 1.0))
            * counted.total()
            / (counted.total() + _SHRINK),
        )
        for key, counted in by_word.items()
    }


def _entropy(counted: Counter[ClauseMeaning | None]) -> float:
    total = counted.total()
    return -sum(count / total * math.log(count / total) for count in counted.values())


def aligned(
    tokens: Words, mentions: Sequence[Mention], intent: Sequence[IntentClause]
) -> Iterator[tuple[Clause, ClauseMeaning | None]]:
    """Yield the clauses of a training instruction with their meanings, and each mention outside them without one.

    Demands that no mention fits are left out. They may be about any other mention, so then these are left out too.
    """
    demands = _merged(intent)
    spans = _best_spans(mentions, demands)
    covered: set[int] = set()
    for demand, thing, place in spans:
        first, last = (
            min(thing, thing if place is None else place),
            max(thing, thing if place is None else place),
        )
        covered.update(range(first, last + 1))
        meaning = ClauseMeaning(
            demand.predicate, demand.holds, thing - first, None if place is None else place - first
        )
        yield clause_of(tokens, mentions, first, last), meaning
    others = set(range(len(mentions))) - covered if len(spans) == len(demands) else ()
    for at in others:
        yield clause_of(tokens, mentions, at, at), None


@dataclass(frozen=True, slots=True)
class _Demand:
    predicate: str
    holds: bool
    things: frozenset[str]
    places: frozenset[str]


Span = tuple[_Demand, int, int | None]


def _merged(intent: Sequence[IntentClause]) -> list[_Demand]:
    """Join demands that one phrase can state: the same of several things."""
    found: dict[tuple[str, bool, tuple[str, ...], str], set[str]] = {}
    for clause in intent:
        kind = clause.things[0].rpartition("_")[0]
        found.setdefault((clause.predicate, clause.holds, clause.places, kind), set()).update(clause.things)
    return [
        _Demand(predicate, holds, frozenset(things), frozenset(places))
        for (predicate, holds, places, _), things in found.items()
    ]


def _best_spans(mentions: Sequence[Mention], demands: Sequence[_Demand]) -> list[Span]:
    """Choose mentions for the demands so that most demands are stated and most mentions explained, without overlap."""
    best: tuple[tuple[int, int], list[Span]] = ((0, 0), [])

    def extend(at: int, spans: list[Span], covered: frozenset[int], known: frozenset[str]) -> None:
        nonlocal best
        score = (len(spans), len(covered))
        if score > best[0]:
            best = (score, list(spans))
        if at == len(demands) or len(spans) + len(demands) - at < best[0][0]:
            return
        demand = demands[at]
        for thing, place in _options(mentions, demand, known):
            ends = {thing, thing if place is None else place}
            span = frozenset(range(min(ends), max(ends) + 1))
            strangers = [other for other in span - ends if not mentions[other].is_pronoun]
            if not strangers and not span & covered and len(span) <= MOST_MENTIONS:
                names = known | demand.things | demand.places
                extend(at + 1, [*spans, (demand, thing, place)], covered | span, names)
        extend(at + 1, spans, covered, known | demand.things)

    extend(0, [], frozenset(), frozenset())
    return best[1]


def _options(
    mentions: Sequence[Mention], demand: _Demand, known: frozenset[str]
) -> Iterator[tuple[int, int | None]]:
    """Yield the mentions that may be a demand's thing and place. A pronoun stands for an object of an earlier demand."""

    def fits(mention: Mention, names: frozenset[str]) -> bool:
        if mention.is_pronoun:
            return bool(names & known)
        return any(row.name in names for row in mention.rows)

    things = [at for at, mention in enumerate(mentions) if fits(mention, demand.things)]
    if not demand.places:
        yield from ((thing, None) for thing in things)
        return
    places = [at for at, mention in enumerate(mentions) if fits(mention, demand.places)]
    yield from ((thing, place) for thing in things for place in places if thing != place)
