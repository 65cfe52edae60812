"""Instructions for the needs of a day: reasons, sentences that imply a need, pronouns, deadlines."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pytest

from embomatrix.factory.language.clauses import PhraseBook
from embomatrix.factory.language.references import Describer
from embomatrix.factory.social.day import NeedOfDay
from embomatrix.factory.social.knowledge import Event, GoalPart, Need, events
from embomatrix.factory.social.telling import Asked, Teller, UndescribableError
from embomatrix.factory.social.values import Person
from embomatrix.factory.social.wish import Condition, Quantity, Wish, WishedObjects, WishPredicate
from embomatrix.factory.writer.words import Voice
from embomatrix.skills.prompt import PromptRow
from embomatrix.world.state import Relation

SEEDS = range(40)
IMPLIED_LABELS = {"guests for dinner 5": {"sofa"}, "home office 2": {"desk"}}
"""Labels of conditions that another condition of the need implies: what is on the shelf is not on the sofa."""

ROWS = (
    PromptRow(0, "laptop_1", "laptop", "bedroom_0", "bookcase_1", Relation.ONTOP),
    PromptRow(1, "mug_1", "mug", "office_0", "desk_1", Relation.ONTOP),
    PromptRow(2, "mug_2", "mug", "office_0", "desk_1", Relation.ONTOP),
    PromptRow(3, "sink_1", "furniture_sink", "kitchen_0", fixed=True),
    PromptRow(4, "desk_1", "desk", "office_0", fixed=True),
    PromptRow(5, "bookcase_1", "bookcase", "bedroom_0", fixed=True),
    PromptRow(6, "radio_1", "radio", "bedroom_0", "bookcase_1", Relation.ONTOP, states=("on",)),
)
OFFICE = next(event for event in events() if event.name == "home office")
ELIF = Person(name="Elif", age=41, job="translator", hobby="yoga")


def teller(seed: int, rows: Sequence[PromptRow] = ROWS) -> Teller:
    voice = Voice(np.random.default_rng(seed))
    describer = Describer(
        {row.name: row for row in rows}, ["bedroom_0", "office_0", "kitchen_0"], voice, kind_share=0.0
    )
    return Teller(describer, PhraseBook("train", 0), voice)


def need_of(name: str) -> Need:
    return next(need for need in OFFICE.needs if need.name == name)


def asked(name: str, members: dict[str, tuple[str, ...]]) -> Asked:
    need = need_of(name)
    conditions = tuple(condition_of(part) for part in need.goal)
    kinds = {role.label: role.kinds[0] for role in need.roles}
    objects = tuple(
        WishedObjects(label=label, kind=kinds[label], count=len(names)) for label, names in members.items()
    )
    wish = Wish(objects=objects, conditions=conditions)
    return Asked(NeedOfDay(OFFICE, ELIF, "09:30", need, wish, 0), members, conditions)


LAPTOP = ("home office 1", {"desk": ("desk_1",), "shelf": ("bookcase_1",), "laptop": ("laptop_1",)})
CUPS = ("home office 2", {"desk": ("desk_1",), "cups": ("mug_1", "mug_2"), "sink": ("sink_1",)})
RADIO = ("home office 4", {"shelf": ("bookcase_1",), "radio": ("radio_1",)})


def needs_with_sentences() -> list[Need]:
    return [need for event in events() for need in event.needs if need.say]


def test_nearly_every_need_has_a_sentence_that_implies_it() -> None:
    every = [need for event in events() for need in event.needs]
    assert len(needs_with_sentences()) >= 0.95 * len(every)


@pytest.mark.parametrize("need", needs_with_sentences(), ids=lambda need: need.name)
def test_a_sentence_that_implies_a_need_names_all_that_its_goal_is_about(need: Need) -> None:
    parts = [each for part in need.goal for each in (part, part.otherwise) if each is not None]
    labels = {label for part in parts for label in (part.things, part.place) if label}
    counted = any(part.quantity in (Quantity.EXACTLY, Quantity.SOME_PAIRED) for part in need.goal)
    for sentence in need.say:
        named = set(re.findall(r"\{(\w+)\}", sentence))
        assert named <= {role.label for role in need.roles} | {"I", "me", "k", "time"}
        assert labels - named <= IMPLIED_LABELS.get(need.name, set()), sentence
        assert not counted or "{k}" in sentence or "two" in sentence
        assert sentence[-1] in ".?"


def told_in_full(need: Need, event: Event) -> str:
    """Return the instruction for a need alone among objects of its first kinds."""
    rows: list[PromptRow] = []
    members: dict[str, tuple[str, ...]] = {}
    objects = []
    for role in need.roles:
        kind = next(
            (kind for kind in role.kinds if kind not in {row.category for row in rows}), role.kinds[0]
        )
        names = tuple(f"{role.label}_{number}" for number in range(role.count[1]))
        members[role.label] = names
        objects.append(WishedObjects(label=role.label, kind=kind, count=len(names)))
        host = members.get(role.host, ("",))[0]
        for name in names:
            rows.append(
                PromptRow(len(rows), name, kind, "bedroom_0", host, role.relation, fixed=not role.host)
            )
    conditions = tuple(condition_of(part) for part in need.goal)
    wish = Wish(objects=tuple(objects), conditions=conditions)
    day = NeedOfDay(event, ELIF, "09:30", need, wish, 2)
    return teller(0, rows).instruction([Asked(day, members, conditions)])


def condition_of(part: GoalPart) -> Condition:
    counted = part.quantity in (Quantity.EXACTLY, Quantity.SOME_PAIRED)
    return Condition(
        predicate=part.predicate,
        things=part.things,
        place=part.place,
        quantity=part.quantity,
        count=2 * counted,
        holds=part.holds,
        otherwise=condition_of(part.otherwise) if part.otherwise is not None else None,
    )


@pytest.mark.parametrize(
    ("need", "event"),
    [pytest.param(need, event, id=need.name) for event in events() for need in event.needs if need.say],
)
def test_each_sentence_that_implies_a_need_can_be_told(
    need: Need, event: Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("embomatrix.factory.social.telling.IMPLIED_SHARE", 1.0)
    monkeypatch.setattr("embomatrix.factory.social.telling.BEFORE_SHARE", 0.0)
    text = told_in_full(need, event)
    assert not re.search(r"[{}|]|  |\.\.|one of one of|of one of", text), text
    # The words between the blanks of one of its sentences are there, in this order.
    told = [
        ".*".join(re.escape(part) for part in re.split(r"\{[^{}]*\}", sentence) if len(part) > 4)
        for sentence in need.say
    ]
    assert any(re.search(pattern, text, re.IGNORECASE) for pattern in told), text


@pytest.mark.parametrize("seed", SEEDS)
def test_an_instruction_names_the_person_and_fills_all_blanks(seed: int) -> None:
    text = teller(seed).instruction([asked(*LAPTOP), asked(*CUPS), asked(*RADIO)])
    assert text.count("Elif") >= 1
    assert not re.search(r"[{}|]|  |\.\.", text)
    assert all(sentence[0].isupper() for sentence in re.split(r"(?<=[.?!]) ", text))
    assert {"desk", "sink", "radio"} <= set(re.findall(r"\w+", text))


def test_a_need_is_told_by_a_request_or_by_a_sentence_that_implies_it() -> None:
    texts = [teller(seed).instruction([asked(*LAPTOP)]) for seed in SEEDS]
    implied = [text for text in texts if "can't start before" in text or "is where" in text]
    assert 0.3 * len(texts) <= len(implied) <= 0.7 * len(texts)


def test_the_person_is_a_pronoun_once_their_name_is_said() -> None:
    texts = [teller(seed).instruction([asked(*RADIO), asked(*CUPS)]) for seed in SEEDS]
    third = [text for text in texts if not re.search(r"\b(I|my|me)\b", text)]
    assert third
    assert all(text.count("Elif") <= 2 for text in third)
    assert any(re.search(r"\b[Ss]he\b", text) for text in third)
    assert not any(re.search(r"\b([Hh]e|him|his)\b", text) for text in texts)


def test_some_instructions_say_by_when_and_one_request_is_it() -> None:
    texts = [teller(seed).instruction([asked(*RADIO)]) for seed in range(200)]
    late = [text for text in texts if "before the next call" in text or "back to work" in text]
    assert 0.1 * len(texts) <= len(late) <= 0.3 * len(texts)
    assert not any("all of" in text or "all that" in text for text in late)


def test_a_second_request_of_the_same_kind_may_refer_to_the_first() -> None:
    rows = (*ROWS, PromptRow(7, "mug_3", "coffee_cup", "office_0", "desk_1", Relation.ONTOP))
    need = need_of("home office 2")
    conditions = tuple(
        Condition(predicate=WishPredicate.INSIDE, things=label, place="sink", quantity=Quantity.ALL)
        for label in ("cups", "more")
    )
    members = {"desk": ("desk_1",), "cups": ("mug_1", "mug_2"), "more": ("mug_3",), "sink": ("sink_1",)}
    wish = Wish(
        objects=(
            WishedObjects(label="cups", kind="mug", count=2),
            WishedObjects(label="more", kind="coffee_cup", count=1),
            WishedObjects(label="sink", kind="furniture_sink", count=1),
        ),
        conditions=conditions,
    )
    both = Asked(NeedOfDay(OFFICE, ELIF, "09:30", need, wish, 0), members, conditions)
    texts = [teller(seed, rows).instruction([both]) for seed in range(200)]
    assert any(re.search(r"The same|Do the same|as well|too, please", text) for text in texts)


def test_objects_that_nothing_tells_from_others_are_refused() -> None:
    lost = {"shelf": ("bookcase_1",), "radio": ("mug_1",)}
    with pytest.raises(UndescribableError, match="mug_1"):
        teller(0).instruction([asked("home office 4", lost)])
