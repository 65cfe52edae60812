"""Rules about an instruction and its wish together: the words demand what the conditions demand, and nothing else."""

import re
from collections.abc import Iterator, Sequence
from typing import Final

from embomatrix.factory.language.nouns import everyday_noun
from embomatrix.factory.social.rules.faults import Fault, FaultKind
from embomatrix.factory.social.rules.nouns import Mention, fits, is_object_of_request
from embomatrix.factory.social.rules.reading import INDEFINITE, NUMBERS, UNIVERSAL, Reading
from embomatrix.factory.social.rules.vocabulary import NEGATION, StatedDemand, stated_in
from embomatrix.factory.social.rules.wish_rules import is_negative
from embomatrix.factory.social.scene_kinds import KindInRoom, SceneKinds
from embomatrix.factory.social.wish import (
    PLACED,
    Condition,
    Quantity,
    Wish,
    WishedObjects,
    WishPredicate,
)
from embomatrix.world.bddl import ROOM_TYPES
from embomatrix.world.state import State

_REMOVAL: Final = re.compile(
    rf"\b(?:off|out of|away|remove|clear|empty|from|instead of|longer|leave|elsewhere|somewhere else|{NEGATION})\b"
)
"""Words that say that an object is to leave its place."""
_COUNT_WORDS: Final = 5
"""Words before a noun that may count it."""
_LIMITS: Final = frozenset({"least", "most", "up", "more", "fewer", "about"})
"""Words that turn a number into a limit."""
_ALTERNATIVE: Final = re.compile(r"\b(?:or|either|whichever|otherwise|else|instead|alternatively)\b")
_PREMISE: Final = re.compile(r"\b(?:if|unless|in case|provided)\b(?! (?:you|possible|necessary|need|that's))")
_CLEANED: Final = frozenset({WishPredicate.DUSTY, WishPredicate.STAINED})


class InstructionRules:
    """Rules about one instruction. ``own_rooms`` are rooms of the people, which a reason may name."""

    def __init__(self, reading: Reading, wish: Wish, scene: SceneKinds, own_rooms: frozenset[str]) -> None:
        self._reading = reading
        self._wish = wish
        self._groups = wish.groups
        self._scene = scene
        self._own_rooms = own_rooms
        self._parts = [part for condition in wish.conditions for part in condition.parts()]

    def faults(self) -> tuple[Fault, ...]:
        """Return all broken rules."""
        return (
            *self._unmentioned(),
            *self._unasked_objects(),
            *self._demands(),
            *self._connectives(),
            *self._relations(),
            *self._counts(),
            *self._wrong_rooms(),
            *self._ambiguous(),
        )

    def _mentions_of(self, group: WishedObjects) -> list[Mention]:
        return [each for each in self._reading.mentions if fits(each.noun, group.kind)]

    def _unmentioned(self) -> Iterator[Fault]:
        for label in self._wish.wanted:
            group = self._groups[label]
            if not self._mentions_of(group) and not self._is_pronoun_enough(group):
                name = everyday_noun(group.kind)
                yield Fault(
                    FaultKind.UNMENTIONED,
                    f"a condition is about {label}, and the instruction names no {name}",
                )

    def _is_pronoun_enough(self, group: WishedObjects) -> bool:
        """True for *everything*: it names all portable objects of the wish that have no other word."""
        return "everything" in self._reading.tokens and not group.furniture

    def _unasked_objects(self) -> Iterator[Fault]:
        for mention in self._reading.mentions:
            if any(fits(mention.noun, group.kind) for group in self._wish.objects):
                continue
            if self._reading.has_reason_at(mention):
                continue
            if is_object_of_request(mention, self._reading.tokens):
                yield Fault(
                    FaultKind.UNASKED_OBJECT,
                    f"the instruction names a {mention.noun}, and no condition or start of an object is about one",
                )

    def _demands(self) -> Iterator[Fault]:
        """Compare the states that the words demand with those of the conditions, both with their polarity."""
        described = frozenset(
            WishPredicate(state.value)
            for group in self._wish.objects
            for state in group.states
            if state.value in set(WishPredicate)
        )
        stated = stated_in(self._reading.plain, described)
        wanted = {_demand_of(part) for part in self._parts if part.predicate not in PLACED}
        for predicate, holds in sorted(wanted):
            if (predicate, holds) not in stated.demands:
                yield Fault(
                    FaultKind.UNSTATED, f"no word of the instruction demands {_in_words(predicate, holds)}"
                )
        explained = wanted | {(predicate, True) for predicate in described}
        for demand, words in stated.demands.items():
            if demand not in explained:
                yield Fault(
                    FaultKind.UNSCORED, f"{words!r} demands {_in_words(*demand)}, and no condition does"
                )
        if (
            stated.placing
            and not stated.demands
            and not any(part.predicate in PLACED for part in self._parts)
        ):
            yield Fault(FaultKind.UNSCORED, f"{stated.placing!r} demands a place, and no condition does")
        if stated.other_work:
            yield Fault(
                FaultKind.UNSCORED, f"the robot can't {stated.other_work}, and no condition demands it"
            )

    def _connectives(self) -> Iterator[Fault]:
        """Compare alternatives and premises with the words *or* and *if*."""
        text = self._reading.plain
        if any(part.otherwise for part in self._parts) and not _ALTERNATIVE.search(text):
            yield Fault(FaultKind.UNSTATED, "no word such as or states the alternative of a condition")
        has_premise = any(part.provided for part in self._parts)
        premise = _PREMISE.search(text)
        if has_premise and not premise:
            yield Fault(FaultKind.UNSTATED, "no word such as if states the premise of a condition")
        if premise and not has_premise:
            yield Fault(FaultKind.UNSCORED, f"{premise.group()!r} states a premise, and no condition has one")

    def _relations(self) -> Iterator[Fault]:
        """Compare the prepositions before each place with the relation of its conditions."""
        for part in self._parts:
            if part.predicate not in PLACED:
                continue
            place = self._groups[part.place]
            mentions = self._mentions_of(place)
            said = set(self._reading.relations_to(mentions))
            if is_negative(part):
                said |= set(self._reading.departures_from(mentions))
            if mentions and part.predicate not in said:
                name = everyday_noun(place.kind)
                found = ", ".join(sorted(said)) or "no relation"
                yield Fault(
                    FaultKind.WRONG_RELATION,
                    f"a condition demands {part.predicate.value} of the {name}, and the words state {found}",
                )
            elif is_negative(part) and not _REMOVAL.search(self._reading.plain):
                yield Fault(
                    FaultKind.UNSTATED,
                    f"no word says that {part.things} must leave {part.place}: off, out of, no",
                )
            elif not is_negative(part) and mentions and self._is_denied(mentions, part.predicate):
                yield Fault(
                    FaultKind.UNSTATED, f"the instruction says not to have {part.things} at {part.place}"
                )

    def _is_denied(self, mentions: Sequence[Mention], predicate: WishPredicate) -> bool:
        """True if each mention with this relation is negated in its clause."""
        stated = [each for each in mentions if predicate in set(self._reading.relations_to([each]))]
        return bool(stated) and all(
            re.search(rf"\b{NEGATION}\b", self._reading.clause_before(each)) for each in stated
        )

    def _counts(self) -> Iterator[Fault]:
        for condition in self._wish.conditions:
            group = self._groups[condition.things]
            mentions = self._mentions_of(group)
            if self._counts_pronoun(condition):
                continue
            if mentions and not any(_is_counted(condition, group, each, self._reading) for each in mentions):
                yield Fault(FaultKind.WRONG_COUNT, _count_sentence(condition, group))

    def _counts_pronoun(self, condition: Condition) -> bool:
        """True for an exact number of *them*: *her two plants: move exactly one of them*."""
        if condition.quantity is not Quantity.EXACTLY:
            return False
        found = re.search(r"\b(\w+) of them\b", self._reading.plain)
        return found is not None and NUMBERS.get(found[1]) == condition.count

    def _wrong_rooms(self) -> Iterator[Fault]:
        told = {self._wish.room_of(group.label) for group in self._wish.objects} | self._own_rooms
        types = {self._scene.rooms.get(room, room) for room in told}
        text = " ".join(self._reading.tokens)
        for kind in sorted(ROOM_TYPES):
            words = kind.replace("_", " ")
            if kind not in types and re.search(rf"\b(?:the|a|his|her|our|their|'s) {words}\b", text):
                if any(fits(words, group.kind) for group in self._wish.objects):
                    continue
                yield Fault(
                    FaultKind.WRONG_ROOM,
                    f"the instruction names the {words}, and no object of the wish is there",
                )

    def _ambiguous(self) -> Iterator[Fault]:
        for label in self._wish.wanted:
            group = self._groups[label]
            quantities = {part.quantity for part in self._parts if part.things == label}
            if group.furniture and quantities == {Quantity.ANY}:
                continue
            nouns = {mention.noun for mention in self._mentions_of(group)}
            for other in self._others(group):
                # A noun that fits only the group tells it apart.
                same = nouns and all(fits(noun, other.kind) for noun in nouns)
                if same and not self._is_told_apart(group, other):
                    yield Fault(
                        FaultKind.AMBIGUOUS,
                        f"the words for {label} also fit a {everyday_noun(other.kind)} in {other.room}: name its room, "
                        "its place or its state, or declare and accept all alike ones",
                    )
                    break

    def _others(self, group: WishedObjects) -> Iterator[KindInRoom]:
        """Yield the other objects of wish and scene, furniture only beside furniture."""
        for each in self._wish.objects:
            if each.label != group.label and each.furniture is group.furniture:
                host = self._groups[each.host].kind if each.host else ""
                yield KindInRoom(self._wish.room_of(each.label), each.kind, each.count, host)
        host = self._groups[group.host].kind if group.host else ""
        for there in self._scene.kinds:
            mine = (
                there.kind == group.kind
                and there.room == self._wish.room_of(group.label)
                and host in ("", there.host)
            )
            # The words mean the objects that are there already, as many as the wish declares.
            if bool(there.host) is not group.furniture and there.count > group.count * mine:
                yield there

    def _is_told_apart(self, group: WishedObjects, other: KindInRoom) -> bool:
        """True if the instruction names a room, a place or a state that the group has and the other object has not."""
        room = self._wish.room_of(group.label)
        kinds = self._scene.rooms
        if room != other.room:
            alike = kinds.get(room) == kinds.get(other.room)
            words = (room if alike else kinds.get(room, room)).replace("_", " ")
            if re.search(rf"\b{words}\b", " ".join(self._reading.tokens)):
                return True
        host = self._groups[group.host].kind if group.host else ""
        if host and host != other.host and any(fits(each.noun, host) for each in self._reading.mentions):
            return True
        return any(_state_word(state) in self._reading.plain for state in group.states)


def _state_word(state: State) -> str:
    return {State.TOGGLED_ON: " on", State.STAINED: "stain", State.DUSTY: "dust"}.get(state, state.value)


def _demand_of(part: Condition) -> StatedDemand:
    predicate = WishPredicate.STAINED if part.predicate in _CLEANED else part.predicate
    return predicate, not is_negative(part)


def _in_words(predicate: WishPredicate, holds: bool) -> str:
    if predicate in _CLEANED:
        return "cleaning"
    return predicate.value if holds else f"not {predicate.value}"


def _is_counted(condition: Condition, group: WishedObjects, mention: Mention, reading: Reading) -> bool:
    """True if the words before the noun, and its number, agree with the quantity of the condition."""
    told = reading.before(mention, _COUNT_WORDS)
    words = set(told)
    # Two of the four bowls: the first number is the quantity.
    number = next((NUMBERS.get(word) or int(word) for word in told if word in NUMBERS or word.isdigit()), 0)
    quantity = condition.quantity if group.count > 1 else Quantity.ALL
    match quantity:
        case Quantity.EXACTLY | Quantity.SOME_PAIRED:
            return number == condition.count and not words & _LIMITS
        case Quantity.ANY:
            return bool(words & INDEFINITE) and not words & (UNIVERSAL - {"everything"})
        case Quantity.NONE:
            return (
                re.search(rf"\b{NEGATION}\b", reading.plain) is not None
                or bool(words & UNIVERSAL)
                or mention.is_plural
            )
        case Quantity.PAIRED:
            return bool(words & {"a", "one", "each", "every"}) or mention.is_plural
    if group.count == 1:
        return not mention.is_plural and number in (0, 1) and not words & UNIVERSAL
    if number > 1:
        return number == group.count
    return mention.is_plural or bool(words & {"all", "every", "each", "both"})


def _count_sentence(condition: Condition, group: WishedObjects) -> str:
    wanted = {
        Quantity.EXACTLY: f"exactly {condition.count}",
        Quantity.ANY: "any one",
        Quantity.NONE: "none",
        Quantity.PAIRED: "one for each place",
        Quantity.SOME_PAIRED: f"exactly {condition.count}, each at a place of its own",
    }.get(condition.quantity, f"all {group.count}" if group.count > 1 else "one")
    return (
        f"a condition is about {wanted} of {group.count} {group.label}, and the instruction counts otherwise"
    )
