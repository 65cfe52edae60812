"""Nouns, kinds, clauses and referring expressions of requests."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.factory.language.clauses import (
    Clause,
    NounPhrase,
    PhraseBook,
    Speaker,
    discourse_forms,
    imperative_of,
    sentence_of,
)
from embomatrix.factory.language.kinds import HELD_OUT_KINDS, is_held_out, kinds, kinds_with
from embomatrix.factory.language.nouns import gerund, listed, noun_of, room_noun, with_article
from embomatrix.factory.language.references import Describer, all_of, any_of, exactly
from embomatrix.factory.writer.words import Voice
from embomatrix.skills.prompt import PromptRow
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation

KEYS = (
    "ontop", "inside", "inside bin", "under", "nextto", "not ontop", "not inside", "open", "not open", "toggled_on",
    "not toggled_on", "toggled_on light", "not toggled_on light", "toggled_on tap", "not toggled_on tap", "cooked", "hot",
    "frozen", "not dusty", "not stained", "soaked", "sliced",
)  # fmt: skip


def voice(seed: int = 0) -> Voice:
    return Voice(np.random.default_rng(seed))


def test_nouns_have_english_plurals_and_articles() -> None:
    plurals = {"table_knife": "table knives", "bottle_of_milk": "bottles of milk", "dish_rack": "dish racks"}
    assert {category: noun_of(category).many for category in plurals} == plurals
    assert noun_of("wall_mounted_tv").many == "TVs on the wall"
    assert (with_article("apple"), with_article("mug")) == ("an apple", "a mug")
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert (gerund("put"), gerund("slice")) == ("putting", "slicing")


def test_rooms_are_numbered_only_if_there_are_several_of_a_type() -> None:
    rooms = ["kitchen_0", "bedroom_0", "bedroom_1"]
    assert room_noun("kitchen_0", rooms) == "the kitchen"
    assert room_noun("bedroom_1", rooms) == "bedroom 1"


def test_kinds_have_members_of_the_catalog_and_nouns_of_their_own() -> None:
    catalog = Catalog.load()
    found = list(kinds().values())
    for kind in found:
        assert len(kind.members) > 1
        assert all(catalog.models_of(member) for member in kind.members), kind.name
    assert len({kind.noun.one for kind in found}) == len(found)
    assert kinds_with(frozenset({"apple", "lemon"}))[-1].name == "fruit"


@pytest.mark.parametrize("key", KEYS)
def test_each_request_has_forty_forms_and_no_form_leaves_a_placeholder(key: str) -> None:
    assert discourse_forms(key) >= 40
    place = "the sink" if key in KEYS[:7] or key in ("cooked", "hot", "frozen") else ""
    for split in ("train", "heldout"):
        book = PhraseBook(split, 0)
        for seed in range(60):
            thing = NounPhrase("the mugs", 2) if seed % 2 else NounPhrase("the mug")
            clause = Clause(key, thing, place, "on the table" if seed % 3 else "")
            for speaker in (Speaker(), Speaker("Ada")):
                text = sentence_of(clause, book, voice(seed), speaker)
                assert not re.search(r"[{}]|  ", text), text
                assert text[0].isupper()
                assert text[-1] in ".?"
            assert "{" not in imperative_of(clause, book, voice(seed))


def test_training_never_uses_phrases_of_the_held_out_split() -> None:
    train, heldout = PhraseBook("train", 3), PhraseBook("heldout", 3)
    kept = 0
    for key in KEYS:
        known, every = set(train.verbs(key)), set(heldout.verbs(key))
        assert known <= every
        kept += len(every - known)
    assert kept > len(KEYS) / 2
    assert set(train.forms("do")) < set(heldout.forms("do"))


ROWS = (
    PromptRow(0, "mug_1", "mug", "kitchen_0", "table_1", Relation.ONTOP),
    PromptRow(1, "mug_2", "mug", "kitchen_0", "table_1", Relation.ONTOP),
    PromptRow(2, "mug_3", "mug", "kitchen_0", "sink_1", Relation.INSIDE),
    PromptRow(3, "apple_1", "apple", "kitchen_0", "table_1", Relation.ONTOP),
    PromptRow(4, "lemon_1", "lemon", "bedroom_0"),
    PromptRow(5, "table_1", "breakfast_table", "kitchen_0", fixed=True),
    PromptRow(6, "sink_1", "furniture_sink", "kitchen_0", states=("off",), fixed=True),
    PromptRow(7, "lamp_1", "floor_lamp", "bedroom_0", states=("off",), fixed=True),
    PromptRow(8, "lamp_2", "floor_lamp", "bedroom_0", states=("on",), fixed=True),
)


def describer(seed: int = 0, split: str = "train") -> Describer:
    return Describer({row.name: row for row in ROWS}, ["kitchen_0", "bedroom_0"], voice(seed), split)


@given(st.sets(st.sampled_from([row.name for row in ROWS]), min_size=1, max_size=4), st.integers(0, 50))
def test_a_description_fits_exactly_the_objects_that_are_meant(names: set[str], seed: int) -> None:
    found = describer(seed).describe(sorted(names))
    if found is not None:
        assert describer(seed).denoted(found) == names


def test_an_object_among_others_of_its_kind_is_told_by_its_place() -> None:
    assert describer().definite(["mug_3"], kinds=False) == "the mug in the sink unit"
    assert describer().definite(["mug_1", "mug_2"], kinds=False) == "the mugs on the table"
    assert describer().definite(["mug_1"], kinds=False) == ""


def test_a_state_is_named_only_if_nothing_else_tells_objects_apart() -> None:
    assert describer().definite(["lamp_2"], kinds=False) == "the floor lamp that is on"


def test_words_for_a_kind_of_the_held_out_split_are_unknown_to_training() -> None:
    held_out = {name for name in kinds() if is_held_out(name, 0, HELD_OUT_KINDS)}
    used = set()
    for seed in range(60):
        for name in ("apple_1", "mug_3", "lemon_1", "lamp_1", "table_1", "sink_1"):
            for split in ("train", "heldout"):
                found = describer(seed, split).describe([name])
                assert found is not None
                assert split == "heldout" or found.kind not in held_out
                used.add((split, found.kind))
    assert ("train", "fruit") in used or ("heldout", "fruit") in used


def test_quantities_have_words_of_their_own_number() -> None:
    words = describer()
    mugs = words.describe(["mug_1", "mug_2"], kinds=False)
    assert mugs is not None
    assert all_of(words, mugs, 2).words.split()[-3:] == ["on", "the", "table"]
    assert any_of(words, mugs, 2).count == 1
    assert "one" in exactly(words, mugs, 1, 2).words


def sentences(clause: Clause, split: str = "heldout") -> list[str]:
    return [sentence_of(clause, PhraseBook(split, 0), voice(seed), Speaker()) for seed in range(120)]


def test_a_place_of_the_thing_and_a_place_to_put_it_are_kept_apart() -> None:
    told = sentences(Clause("ontop", NounPhrase("the mugs on one of the desks", 2), "the table"))
    requests = [text for text in told if "from one of the desks" in text]
    assert requests
    assert not [
        text for text in told if re.search(r"\b(put|lay|set|place) the mugs on one of the desks on", text)
    ]
    assert "move the mugs from one of the desks onto the table" in " ".join(told).lower()
    # A floor under a table would be another place.
    assert not [text for text in sentences(Clause("under", NounPhrase("the shoes on the floor", 2), "the table"))
                if "from the floor under" in text]  # fmt: skip


def test_food_is_cooked_on_a_stove_and_in_an_oven() -> None:
    book, steak = PhraseBook("heldout", 0), NounPhrase("the steak")
    said = {
        place: {imperative_of(Clause("cooked", steak, place), book, voice(seed)) for seed in range(60)}
        for place in ("the stove", "the oven")
    }
    assert "cook the steak on the stove" in said["the stove"]
    assert "cook the steak in the oven" in said["the oven"]
    assert not any(" in the stove" in each for each in said["the stove"])


def test_nothing_is_kept_inside_a_sink() -> None:
    book = PhraseBook("heldout", 0)
    clause = Clause("inside", NounPhrase("the mugs", 2), "the sink")
    said = {sentence_of(clause, book, voice(seed), Speaker()) for seed in range(200)}
    assert len(said) > 20
    assert not any(
        re.search(r"inside|[Ss]to(?:re|w)\b|[Pp]ack\b|[Tt]uck\b|put away", each) for each in said
    ), said


def test_a_place_is_told_once_in_a_statement() -> None:
    book = PhraseBook("heldout", 0)
    clause = Clause("ontop", NounPhrase("the book on the desk"), "the shelf")
    said = {sentence_of(clause, book, voice(seed), Speaker()) for seed in range(200)}
    assert not any(re.search(r"on the desk (?:should|must|ought|has) .*be on", each) for each in said), said
    assert any("from the desk" in each for each in said)


def test_the_only_bookcase_of_a_room_is_the_bookcase() -> None:
    rows = [
        PromptRow(0, "bookcase_1", "bookcase", "private_office_0", fixed=True),
        PromptRow(1, "bookcase_2", "bookcase", "bedroom_0", fixed=True),
        PromptRow(2, "key_1", "key", "private_office_0", "bookcase_1", Relation.ONTOP),
        PromptRow(3, "key_2", "key", "bedroom_0", "bookcase_2", Relation.ONTOP),
        PromptRow(4, "key_3", "key", "private_office_0"),
    ]
    said = {
        Describer({row.name: row for row in rows}, ["private_office_0", "bedroom_0"], voice(seed)).definite(
            ["key_1"]
        )
        for seed in range(40)
    }
    assert "the key on the bookcase in the private office" in said
    assert not any("a bookcase in" in each for each in said), said


def test_one_of_several_bookcases_is_a_bookcase() -> None:
    rows = [
        PromptRow(0, "bookcase_1", "bookcase", "bedroom_0", fixed=True),
        PromptRow(1, "bookcase_2", "bookcase", "bedroom_0", fixed=True),
        PromptRow(2, "key_1", "key", "bedroom_0", "bookcase_1", Relation.ONTOP),
        PromptRow(3, "key_2", "key", "bedroom_0"),
    ]
    told = {
        Describer({row.name: row for row in rows}, ["bedroom_0"], voice(seed)).definite(["key_1"])
        for seed in range(20)
    }
    assert "the key on a bookcase" in told
    assert not any("one of the" in words for words in told)


def test_any_of_several_is_asked_for_and_never_stated() -> None:
    for text in sentences(Clause("ontop", NounPhrase("any book on the bookcase"), "the table")):
        assert not re.match("any ", text, re.IGNORECASE), (
            text
        )  # *any book must be on the table* may mean every book


def test_gerunds_join_gerunds() -> None:
    told = " ".join(sentences(Clause("under", NounPhrase("the bag in bedroom 0"), "the table")))
    assert "taking the bag from bedroom 0 and putting it under the table" in told
    assert "and put it under" in told


def test_plural_nouns_and_kinds_without_a_singular_are_never_told_one_by_one() -> None:
    rows = [PromptRow(at, f"jeans_{at}", "jeans", "bedroom_0", "bed_1", Relation.ONTOP) for at in range(3)]
    rows += [PromptRow(5 + at, f"mug_{at}", "mug", "kitchen_0", "table_1", Relation.ONTOP) for at in range(3)]
    for seed in range(60):
        teller = Describer(
            {row.name: row for row in rows}, ["kitchen_0", "bedroom_0"], voice(seed), "heldout"
        )
        for names in (["jeans_0", "jeans_1", "jeans_2"], ["mug_0", "mug_1", "mug_2"]):
            found = teller.describe(names)
            assert found is not None
            words = all_of(teller, found, 3).words
            assert not words.startswith(("every jeans", "every thing", "each thing")), words
        single = teller.describe(["mug_0"])
        assert single is None or "thing to drink from" not in teller.phrase(single, 1)
