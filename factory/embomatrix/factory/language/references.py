"""Referring expressions: descriptions that fit exactly the intended objects among the listed ones.

A description combines a noun (of the category, or of a kind) with a state, a support, a room or contents. Its denotation is
computed from the rows of a prompt, so a policy has all that is needed to find the objects.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from embomatrix.factory.language.clauses import NounPhrase
from embomatrix.factory.language.kinds import HELD_OUT_KINDS, is_held_out, kinds_with
from embomatrix.factory.language.nouns import (
    Noun,
    is_plural,
    listed,
    noun_of,
    number_word,
    room_noun,
    with_article,
)
from embomatrix.factory.writer.words import Voice
from embomatrix.skills.prompt import PromptRow
from embomatrix.world.state import Relation

_PREPOSITIONS: Final[Mapping[Relation, str]] = {
    Relation.ONTOP: "on",
    Relation.INSIDE: "in",
    Relation.UNDER: "under",
}
_BEFORE: Final = ("open", "closed", "dusty", "stained", "frozen", "hot", "cooked", "sliced", "soaked")
_AFTER: Final[Mapping[str, str]] = {"on": "that is on", "off": "that is off"}
"""Visible states as adjectives, and as clauses after the noun."""


@dataclass(frozen=True, slots=True)
class Description:
    """Noun with restrictions. Empty restrictions apply to every object.

    ``use`` replaces the noun of a single, arbitrary object: *something to drink from*.
    """

    noun: Noun
    categories: frozenset[str]
    kind: str = ""
    use: str = ""
    several: bool = False
    """True if the noun has no natural singular."""
    state: str = ""
    room: str = ""
    relation: Relation | None = None
    hosts: frozenset[str] = frozenset()
    """Supports; the empty name stands for the floor."""
    host_words: str = ""
    contents: frozenset[str] = frozenset()
    contents_words: str = ""

    def fits(self, row: PromptRow, rows: Mapping[str, PromptRow]) -> bool:
        """True if the description fits the row."""
        return (
            row.category in self.categories
            and (not self.state or self.state in row.states)
            and (not self.room or row.room == self.room)
            and (not self.hosts or self._is_at_host(row))
            and (not self.contents or any(rows[name].host == row.name for name in self.contents))
        )

    def _is_at_host(self, row: PromptRow) -> bool:
        """True if one of the supports bears the row; what stands on the floor has no relation in a prompt."""
        if not row.host:
            return "" in self.hosts and not row.fixed
        return row.host in self.hosts and row.relation is self.relation

    @property
    def weight(self) -> int:
        """Number of restrictions."""
        return sum(map(bool, (self.state, self.room, self.hosts, self.contents)))


@dataclass(frozen=True)
class Describer:
    """Describer of listed objects. ``taken`` are objects that the request moves, so they identify no furniture.

    ``rooms`` lists all rooms of the scene.
    """

    rows: Mapping[str, PromptRow]
    rooms: Sequence[str]
    voice: Voice
    split: str = "train"
    seed: int = 0
    taken: frozenset[str] = frozenset()
    kind_share: float = 0.45
    """Share of descriptions that use a kind's noun where one fits."""
    cache: dict[frozenset[str], Description | None] = field(default_factory=dict, compare=False)

    def describe(self, names: Sequence[str], *, kinds: bool = True) -> Description | None:
        """Return a description that fits exactly these objects; None if there is none.

        Of the descriptions with the fewest restrictions one is drawn; sometimes one with a restriction more.
        """
        wanted = frozenset(names)
        found = [each for each in self._candidates(wanted, kinds=kinds) if self.denoted(each) == wanted]
        if not found:
            return None
        found = [
            each for each in found if not each.state
        ] or found  # a state may change before the words are heeded
        least = min(each.weight for each in found)
        slack = 1 if self.voice.rng.random() < OVERSPECIFIED else 0
        short = [each for each in found if each.weight <= least + slack]
        of_kind = [each for each in short if each.kind]
        if of_kind and self.voice.rng.random() < self.kind_share:
            short = of_kind
        else:
            short = [each for each in short if not each.kind] or short
        return short[int(self.voice.rng.integers(len(short)))]

    def denoted(self, description: Description) -> frozenset[str]:
        """Return the names of all rows that the description fits."""
        return frozenset(name for name, row in self.rows.items() if description.fits(row, self.rows))

    def place_words(self, name: str) -> str:
        """Return the present place of an object as a phrase, such as *on the table*; empty if no row supports it."""
        row = self.rows[name]
        if not row.host or row.host not in self.rows:
            return ""
        words = self.definite((row.host,), kinds=False)
        known = row.relation is not None and row.relation in _PREPOSITIONS
        return f"{_PREPOSITIONS[row.relation]} {words}" if words and known and row.relation else ""

    def definite(self, names: Sequence[str], *, kinds: bool = True) -> str:
        """Return a definite noun phrase for all of the objects, or "" if no description fits exactly them."""
        found = self.describe(names, kinds=kinds)
        return self.phrase(found, len(names)) if found is not None else ""

    def phrase(self, description: Description, count: int, determiner: str = "the") -> str:
        """Return the noun phrase with this determiner, which may be empty."""
        noun = description.noun.at(count)
        if description.categories == {FLOOR}:
            room = description.room or next(row.room for row in self.rows.values() if row.category == FLOOR)
            return f"{determiner} {noun} of {room_noun(room, self.rooms)}".strip()
        words = [determiner] * bool(determiner)
        if description.state in _BEFORE:
            words.append(description.state)
        words += [noun, *self._after(description)]
        return " ".join(words)

    def _after(self, description: Description) -> Iterator[str]:
        if description.state in _AFTER:
            yield _AFTER[description.state]
        if description.contents:
            yield f"with {description.contents_words}"
        if description.hosts and description.relation is not None:
            yield f"{_PREPOSITIONS[description.relation]} {description.host_words}"
        if description.room:
            yield f"in {room_noun(description.room, self.rooms)}"

    def _candidates(self, wanted: frozenset[str], *, kinds: bool) -> Iterator[Description]:
        rows = [self.rows[name] for name in wanted]
        categories = frozenset(row.category for row in rows)
        heads: list[Description] = []
        if len(categories) == 1:
            heads.append(self._head(rows[0].category))
        if kinds:
            heads += [
                Description(kind.noun, kind.members, kind.name, kind.use, kind.several)
                for kind in kinds_with(categories)
                if not (kind.several and len(wanted) == 1)
                if self.split == "heldout" or not is_held_out(kind.name, self.seed, HELD_OUT_KINDS)
            ]
        restrictions = list(self._restrictions(rows))
        for head, size in itertools.product(heads, range(3)):
            for chosen in itertools.combinations(restrictions, size):
                if len({key for restriction in chosen for key in restriction}) == sum(map(len, chosen)):
                    changes = {key: value for restriction in chosen for key, value in restriction.items()}
                    found = dataclasses.replace(head, **changes)
                    if not found.room or f"in {room_noun(found.room, self.rooms)}" not in found.host_words:
                        yield self._with_host_of_room(found)

    def _with_host_of_room(self, description: Description) -> Description:
        """Return the description with *the bookcase in the office* for *a bookcase*, if the room has only one."""
        here = [name for name in description.hosts if name and self.rows[name].room == description.room]
        if not description.room or len(description.hosts) < 2 or len(here) != 1:
            return description
        words = self.phrase(self._head(self.rows[here[0]].category), 1)
        return dataclasses.replace(description, host_words=words)

    def _head(self, category: str) -> Description:
        """Return the noun of a category, which also fits objects with a longer noun: a coffee table is a table."""
        noun = noun_of(category)
        known = {row.category for row in self.rows.values()}
        longer = {other for other in known if noun_of(other).one.endswith(f" {noun.one}")}
        return Description(noun, frozenset({category, *longer}))

    def _restrictions(self, rows: Sequence[PromptRow]) -> Iterator[Mapping[str, Any]]:
        """Yield restrictions that hold of all rows: a state, a support, a room, contents."""
        shared_states = set.intersection(*(set(row.states) for row in rows))
        for state in sorted(shared_states & {*_BEFORE, *_AFTER}):
            yield {"state": state}
        hosts, relations = {row.host for row in rows}, {row.relation for row in rows}
        if hosts == {""} and not any(row.fixed for row in rows):
            yield {"relation": Relation.ONTOP, "hosts": frozenset({""}), "host_words": "the floor"}
        elif len(hosts) == 1 and len(relations) == 1:
            for host_rows, words in self._host_words(next(iter(hosts))):
                yield {"relation": next(iter(relations)), "hosts": host_rows, "host_words": words}
        if len({row.room for row in rows}) == 1 and rows[0].room:
            yield {"room": rows[0].room}
        if len(rows) == 1:
            yield from self._contents(rows[0])

    def _contents(self, row: PromptRow) -> Iterator[Mapping[str, Any]]:
        """Yield a restriction by what stays on or in a piece of furniture."""
        held = [
            other for other in self.rows.values() if other.host == row.name and other.name not in self.taken
        ]
        if not held or not row.fixed:
            return
        other = held[int(self.voice.rng.integers(len(held)))]
        alike = [each for each in held if each.category == other.category]
        noun = noun_of(other.category)
        words = with_article(noun.one) if len(alike) == 1 and not is_plural(noun.one) else noun.many
        where = _PREPOSITIONS.get(other.relation or Relation.ONTOP, "on")
        same = frozenset(
            each.name
            for each in self.rows.values()
            if each.category == other.category and each.relation is other.relation
        )
        yield {"contents": same, "contents_words": f"{words} {where} it"}

    def _host_words(self, host: str) -> Iterator[tuple[frozenset[str], str]]:
        """Yield descriptions of a support by its noun, and by its noun and room, with all rows that they fit.

        One of several is *a bookcase*: *the mug on one of the bookcases* sounds as if the mug could be anywhere.
        """
        row = self.rows.get(host)
        if row is None:
            return
        head = self._head(row.category)
        for each in (head, dataclasses.replace(head, room=row.room)):
            found = self.denoted(each)
            if len(found) == 1:
                yield found, self.phrase(each, 1)
                return
            yield found, with_article(self.phrase(each, 1, ""))


FLOOR: Final = "floors"
OVERSPECIFIED: Final = 0.25
"""Share of descriptions with a restriction more than they need."""


def all_of(describer: Describer, description: Description, count: int) -> NounPhrase:
    """Return words for all objects of the description: *the mug*, *both mugs*, *every mug on the table*."""
    if count == 1:
        return _one(describer.phrase(description, 1), description)
    many = f"{number_word(count)} "
    options = [
        ("the", 2), (f"the {number_word(count)}", 2), ("all the", 2),
        ("both" if count == 2 else f"all {many}", 2), ("every", 1), ("each of the", 1),
    ]  # fmt: skip
    if description.hosts or description.contents:
        options = options[:4]  # *each of the pillows on a bookcase* is too much
    determiner, number = options[int(describer.voice.rng.integers(len(options)))]
    if determiner == "every" and (description.several or is_plural(description.noun.one)):
        determiner, number = "all the", 2  # there is no *every jeans*
    singular = determiner == "every"
    words = describer.phrase(description, 1 if singular else count, determiner.strip())
    return NounPhrase(words, 1 if number == 1 else count)


def any_of(describer: Describer, description: Description, count: int) -> NounPhrase:
    """Return words for any one object of the description: *one of the mugs*, *something to drink from*."""
    options = [
        describer.phrase(description, count, "one of the"),
        describer.phrase(description, count, "any of the"),
    ]
    if not description.several:
        options += [
            with_article(describer.phrase(description, 1, "")),
            describer.phrase(description, 1, "any"),
        ]
    if description.use:
        options += 2 * [" ".join([description.use, *describer._after(description)])]
    return NounPhrase(describer.voice.choose(options))


def exactly(describer: Describer, description: Description, count: int, whole: int) -> NounPhrase:
    """Return words for an exact number of the objects: *two of the mugs*, *all but one of the mugs*."""
    word = number_word(count)
    options = [
        describer.phrase(description, whole, f"exactly {word} of the"),
        describer.phrase(description, whole, f"{word} of the"),
        describer.phrase(description, whole, f"just {word} of the"),
    ]
    if count == whole - 1 and whole > 2:
        options += 2 * [describer.phrase(description, whole, "all but one of the")]
        options.append(f"{describer.phrase(description, whole, 'all the')} except one")
    return NounPhrase(describer.voice.choose(options), count)


def _one(words: str, description: Description) -> NounPhrase:
    return NounPhrase(words, 2 if is_plural(description.noun.one) else 1)


def together(phrases: Sequence[NounPhrase]) -> NounPhrase:
    """Return one noun phrase for several: *the plate and both mugs*."""
    if len(phrases) == 1:
        return phrases[0]
    return NounPhrase(listed([each.words for each in phrases]), sum(max(1, each.count) for each in phrases))
