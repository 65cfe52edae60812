"""Instruction for the needs of a task: who asks and why, then each request in words that fit exactly its objects.

A request is told by its clauses, or by a sentence that implies them. The describer sees the rows of the prompt only.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from embomatrix.factory.language.clauses import (
    Clause,
    NounPhrase,
    PhraseBook,
    Speaker,
    capitalised,
    imperative_of,
    sentence_of,
)
from embomatrix.factory.language.nouns import listed, noun_of, number_word
from embomatrix.factory.language.references import Describer, Description, all_of, any_of, exactly, together
from embomatrix.factory.social.day import NeedOfDay
from embomatrix.factory.social.household import is_female
from embomatrix.factory.social.wish import PAIRS, PLACED, Condition, Quantity, WishPredicate
from embomatrix.factory.writer.words import Voice

IMPLIED_SHARE: Final = 0.5
"""Share of needs told by a sentence that implies the conditions, if the need has one."""
FIRST_PERSON_SHARE: Final = 0.5
PRONOUN_SHARE: Final = 0.8
WHENCE_SHARE: Final = 0.6
TOGETHER_SHARE: Final = 0.6
"""Share of requests with the same place that are told in one clause."""
BEFORE_SHARE: Final = 0.2
"""Share of instructions that say by when, if the event has words for it."""
SAME_SHARE: Final = 0.6
"""Share of requests that only refer to the one before, if they ask for the same of other things."""
_TAKES_NO_JOINT: Final = re.compile(
    r"(The same|And |Do the same|Why |How about)"
    r"|.*( (is|are) still | still (has|have) | can't stay |, but (it|they) should |too, please\.$|\?$)"
)
"""Sentences that read badly after *first* or *finally*."""
PRONOUNS: Final = ("She", "He")
LIGHTS: Final = frozenset({"table_lamp", "floor_lamp"})
BINS: Final = ("trash_can", "_bin")
TAPS: Final = ("_sink", "bathtub")
_CHOICE: Final = re.compile(r"\{([^{}|]*)\|([^{}|]*)\}")
_NAME: Final = re.compile(r"\{(\w+)\}")
_INNER_PRONOUN: Final = re.compile(r"(?<=[\w,;:] )(?:He|She)\b")
"""Pronoun of a speaker inside a sentence."""
_GREETINGS: Final = ("{name} here. ", "This is {name}. ", "It's {name}. ", "Hi, it's {name}. ")


class UndescribableError(Exception):
    """Objects that no description distinguishes from the other rows of the prompt."""


@dataclass(frozen=True, slots=True)
class Asked:
    """Need with the rows that its labels stand for, and its conditions on them."""

    need: NeedOfDay
    members: Mapping[str, tuple[str, ...]]
    conditions: Sequence[Condition]


class _Said(NamedTuple):
    """Sentence of an instruction. Requests can take joints, sentences that imply them can't."""

    sentence: str
    is_request: bool


@dataclass(frozen=True)
class Teller:
    """Teller of needs to the robot."""

    describer: Describer
    book: PhraseBook
    voice: Voice

    def instruction(self, asked: Sequence[Asked]) -> str:
        """Return the instruction for needs of one person. Raise UndescribableError."""
        first = asked[0].need
        speaker = Speaker() if self._rng() < FIRST_PERSON_SHARE else Speaker(first.person.name)
        greeting = "" if speaker.name else self.voice.choose(_GREETINGS).format(name=first.person.name)
        why = self._personal(
            _naming(self.voice.choose(self.book.of_split("why", first.event.why))), first, speaker
        )
        is_named = bool(speaker.name) and speaker.name in why
        later = Speaker("She" if is_female(speaker.name) else "He") if is_named else speaker
        parts = [greeting + capitalised(why)]
        groups = [list(group) for _, group in itertools.groupby(asked, key=lambda each: each.need.event.name)]
        for number, needs in enumerate(groups):
            event = needs[0].need.event
            if number:
                parts.append(self._turn_to(needs[0].need, later))
            said = [said for each in needs for said in self._requests(each, later)]
            known = bool(speaker.name) and any(speaker.name in part for part in parts)
            parts.append(self._joined(said, speaker.name, known=known, ends=number == len(groups) - 1))
            if event.before and self._rng() < BEFORE_SHARE:
                parts.append(
                    self._deadline(
                        needs[0].need, later, is_one=len(needs) == 1 and len(needs[0].conditions) == 1
                    )
                )
        text = _INNER_PRONOUN.sub(lambda match: match.group(0).lower(), " ".join(parts))
        return text if first.person.name in text else f"{first.person.name} says: {text}"

    def _turn_to(self, need: NeedOfDay, speaker: Speaker) -> str:
        """Return the reason of a later event, after words that turn to another matter."""
        why = self._personal(self.voice.choose(self.book.of_split("why", need.event.why)), need, speaker)
        return f"{self.voice.choose(self.book.joints('turn'))}{capitalised(why)}"

    def _deadline(self, need: NeedOfDay, speaker: Speaker, *, is_one: bool) -> str:
        """Return a sentence about the time by which the requests are to be met."""
        words = self.voice.choose(self.book.joints("by one" if is_one else "by"))
        before = self._personal(self.voice.choose(need.event.before), need, speaker)
        return words.format(before=before, **speaker.fields())

    def reason(self, need: NeedOfDay) -> str:
        """Return a sentence about the event in the first person."""
        return self._personal(self.voice.choose(self.book.of_split("why", need.event.why)), need, Speaker())

    def _rng(self) -> float:
        return float(self.voice.rng.random())

    def _joined(self, said: Sequence[_Said], name: str, *, known: bool, ends: bool) -> str:
        """Return the sentences with joints before some of them.

        ``name`` is the speaker's, ``known`` if it was said before. ``ends``: nothing follows.
        """
        told: list[str] = []
        for number, (sentence, is_request) in enumerate(said):
            if name and known and sentence.startswith(f"{name} "):
                sentence = f"{'She' if is_female(name) else 'He'}{sentence.removeprefix(name)}"
            known = known or (bool(name) and name in sentence)
            last = ends and number == len(said) - 1
            short = ends and len(said) == 2
            kind = "first" if not number else "second" if short else "last" if last else "next"
            # *First of all* and *finally* are too much for two requests.
            takes_joint = (
                is_request
                and len(said) > 1
                and not (short and not number)
                and not _TAKES_NO_JOINT.match(sentence)
            )
            joint = self.voice.choose(self.book.joints(kind)) if takes_joint else ""
            told.append(f"{joint}{_lowered(sentence, (name,))}" if joint else sentence)
        return " ".join(told)

    def _requests(self, asked: Asked, speaker: Speaker) -> list[_Said]:
        if asked.need.need.say and not self._leaves_choice(asked) and self._rng() < IMPLIED_SHARE:
            return [_Said(self._implied(asked, speaker), is_request=False)]
        return [_Said(sentence, is_request=True) for sentence in self._clauses(asked, speaker)]

    def _leaves_choice(self, asked: Asked) -> bool:
        """True if a place may be any of several pieces of furniture, which sentences of needs don't provide for."""
        return any(
            each.place and len(asked.members[each.place]) > 1 and each.quantity not in PAIRS
            for each in asked.conditions
        )

    def _implied(self, asked: Asked, speaker: Speaker) -> str:
        options = self.book.of_split("say", asked.need.need.say)
        text = self._personal(self.voice.choose(options), asked.need, speaker)

        def words(match: re.Match[str]) -> str:
            label = match.group(1)
            return number_word(asked.need.count) if label == "k" else self._known(asked, label)

        sentences = re.split(r"(?<=[.!?]) ", _NAME.sub(words, text))
        return " ".join(map(capitalised, sentences))

    def _known(self, asked: Asked, label: str) -> str:
        """Return words for all objects of a label, or for any one of them if the conditions leave the choice."""
        names = asked.members[label]
        is_free = any(each.things == label and each.quantity is Quantity.ANY for each in asked.conditions)
        is_place = any(each.place == label and each.quantity not in PAIRS for each in asked.conditions)
        if len(names) == 1 or not (is_free or is_place):
            return self._definite(names)
        found = self._described(names)
        many = self.describer.phrase(found, len(names))
        return (
            many
            if is_free and label in _offered(asked)
            else self.describer.phrase(found, len(names), "one of the")
        )

    def _personal(self, text: str, need: NeedOfDay, speaker: Speaker) -> str:
        """Fill in the person, their pronouns and the time."""
        text = _CHOICE.sub(lambda match: self._choice(match, need, speaker), text)
        their = "her" if is_female(need.person.name) else "his"
        them = "her" if is_female(need.person.name) else "him"
        possessive = their.capitalize() if speaker.name in PRONOUNS else f"{speaker.name}'s"
        fields = {
            "I": speaker.name or "I",
            "my": possessive if speaker.name else "my",
            "their": their if speaker.name else "my",
            "me": them if speaker.name else "me",
            "Me": speaker.name or "me",
            "time": need.time,
        }
        return _NAME.sub(lambda match: fields.get(match.group(1), match.group(0)), text)

    def _choice(self, match: re.Match[str], need: NeedOfDay, speaker: Speaker) -> str:
        first, third = match.groups()
        if third == "their":
            third = "her" if is_female(need.person.name) else "his"
        return third if speaker.name else first

    def _described(self, names: Sequence[str]) -> Description:
        found = self.describer.describe(names)
        if found is None:
            raise UndescribableError(", ".join(names))
        return found

    def _definite(self, names: Sequence[str]) -> str:
        words = self.describer.definite(names)
        if not words:
            raise UndescribableError(", ".join(names))
        return words

    def _clauses(self, asked: Asked, speaker: Speaker) -> list[str]:
        """Return a sentence for each condition. Conditions with the same place may share one; repeated things are pronouns."""
        said: list[str] = []
        before: frozenset[str] = frozenset()
        last = ("", "")
        for group in self._grouped([each for each in asked.conditions if not _is_implied(each, asked)]):
            names = frozenset(name for each in group for name in asked.members[each.things])
            counted = group[0].quantity in (Quantity.ANY, Quantity.EXACTLY, *PAIRS)
            bare = names == before and not counted and self._rng() < PRONOUN_SHARE
            clause = self._clause(group, asked.members, bare=bare)
            act = (clause.key, clause.place)
            if act == last and not counted and not bare and self._rng() < SAME_SHARE:
                words = {"x": clause.thing.words, "X": clause.thing.words}
                said.append(capitalised(self.voice.choose(self.book.joints("same")).format(**words)))
            else:
                said.append(sentence_of(clause, self.book, self.voice, speaker))
            last = act
            before = names if not counted or len(names) == 1 else frozenset()
        return said

    def _grouped(self, conditions: Sequence[Condition]) -> list[list[Condition]]:
        groups: list[list[Condition]] = []
        for condition in conditions:
            last = groups[-1][-1] if groups else None
            same = (
                last is not None
                and condition.predicate in PLACED
                and last.quantity is condition.quantity is Quantity.ALL
                and last.otherwise is condition.otherwise is None
                and (last.predicate, last.place) == (condition.predicate, condition.place)
            )
            if same and self._rng() < TOGETHER_SHARE:
                groups[-1].append(condition)
            else:
                groups.append([condition])
        return groups

    def _clause(
        self, group: Sequence[Condition], members: Mapping[str, tuple[str, ...]], *, bare: bool
    ) -> Clause:
        first = group[0]
        names = [name for each in group for name in members[each.things]]
        pronoun = NounPhrase("it" if len(names) == 1 else "them", len(names))
        thing = pronoun if bare else self._things(group, members)
        place = self._place(first, members) if first.place else ""
        whence = ""
        if (
            first.quantity is Quantity.ALL
            and first.otherwise is None
            and len({self._host(name) for name in names}) == 1
            and self._rng() < WHENCE_SHARE
        ):
            whence = self.describer.place_words(names[0])
        if whence and noun_of(self.describer.rows[self._host(names[0])].category).one in thing.words:
            whence = ""
        return Clause(self._key(first, names, members.get(first.place, ())), thing, place, whence, bare)

    def _host(self, name: str) -> str:
        return self.describer.rows[name].host

    def _key(self, condition: Condition, names: Sequence[str], places: Sequence[str]) -> str:
        holds = condition.holds and condition.quantity is not Quantity.NONE
        key = condition.predicate.value if holds else f"not {condition.predicate.value}"
        if key == "inside" and self.describer.rows[places[0]].category.endswith(BINS):
            return "inside bin"
        if condition.predicate is WishPredicate.TOGGLED_ON:
            category = self.describer.rows[names[0]].category
            if category in LIGHTS:
                return f"{key} light"
            if category.endswith(TAPS):
                return f"{key} tap"
        return key

    def _things(self, group: Sequence[Condition], members: Mapping[str, tuple[str, ...]]) -> NounPhrase:
        if len(group) > 1:
            every = [name for each in group for name in members[each.things]]
            of_kind = self.describer.describe(every)
            if of_kind is not None and self._rng() < TOGETHER_SHARE:
                return all_of(self.describer, of_kind, len(every))
            return together([self._quantified(each, members[each.things]) for each in group])
        if group[0].otherwise is not None:
            return self._either(group[0], members)
        return self._quantified(group[0], members[group[0].things])

    def _either(self, condition: Condition, members: Mapping[str, tuple[str, ...]]) -> NounPhrase:
        """Return *either the muffin or the bagel*."""
        parts = [part for part in (condition, condition.otherwise) if part is not None]
        words = [self._definite(members[part.things]) for part in parts]
        return NounPhrase(f"either {listed(words, 'or')}")

    def _quantified(self, condition: Condition, names: Sequence[str]) -> NounPhrase:
        found = self._described(names)
        match condition.quantity:
            case Quantity.ANY:
                return (
                    any_of(self.describer, found, len(names))
                    if len(names) > 1
                    else all_of(self.describer, found, 1)
                )
            case Quantity.EXACTLY | Quantity.SOME_PAIRED:
                return exactly(self.describer, found, condition.count, len(names))
            case Quantity.PAIRED:
                return NounPhrase(self.describer.phrase(found, len(names), "one of the"))
            case _:
                return all_of(self.describer, found, len(names))

    def _place(self, condition: Condition, members: Mapping[str, tuple[str, ...]]) -> str:
        names = members[condition.place]
        found = self._described(names)
        if condition.quantity is Quantity.PAIRED:
            return self.describer.phrase(found, 1, "each")
        if condition.quantity is Quantity.SOME_PAIRED:
            return self.describer.phrase(found, len(names), self.voice.choose(("different", "separate")))
        if len(names) == 1:
            return self.describer.phrase(found, 1)
        return self.describer.phrase(found, len(names), "one of the")

    def in_short(self, asked: Asked) -> list[str]:
        """Return the conditions as imperatives, for a dialogue. Raise UndescribableError."""
        return [
            imperative_of(self._clause([condition], asked.members, bare=False), self.book, self.voice)
            for condition in asked.conditions
            if not _is_implied(condition, asked)
        ]


def _offered(asked: Asked) -> frozenset[str]:
    """Return the labels that the need's own conditions leave a choice of: its sentences say so themselves."""
    return frozenset(part.things for part in asked.need.need.goal if part.quantity is Quantity.ANY)


def _naming(why: str) -> str:
    """Return the sentence with the person's name at their first mention, if that is *me* or *my*."""
    if "{I}" in why:
        return why
    return why.replace("{my|their}", "{my}", 1) if "{my|their}" in why else why.replace("{me}", "{Me}", 1)


def _is_implied(condition: Condition, asked: Asked) -> bool:
    """True for *none of the books on the sofa* if the same books are to be elsewhere."""
    return condition.quantity is Quantity.NONE and any(
        other.things == condition.things and other.quantity is Quantity.ALL and other.predicate in PLACED
        for other in asked.conditions
    )


def _lowered(sentence: str, names: Container[str]) -> str:
    """Return the sentence with a small first letter, unless its first word is a name or *I*."""
    first = sentence.partition(" ")[0]
    if first in names or first.partition("'")[0] in ("I", "TV", "TVs"):
        return sentence
    return f"{sentence[:1].lower()}{sentence[1:]}"
