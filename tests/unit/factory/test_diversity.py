"""Diversity figures against values calculated by hand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.factory.metrics.diversity import (
    bleu,
    distinct,
    diversity,
    named_share,
    near_duplicates,
    normalised_entropy,
    self_bleu,
)
from embomatrix.scripts.similarity import words_in

TEXTS = st.lists(
    st.lists(st.sampled_from("abcdef"), min_size=1, max_size=8).map(tuple), min_size=2, max_size=6
)


def test_words_are_lower_case_and_split_at_underscores():
    assert words_in("Put Mia's apple in the top_cabinet_0, please!") == (
        "put", "mia's", "apple", "in", "the", "top", "cabinet", "0", "please",
    )  # fmt: skip


def test_distinct_counts_each_gram_once():
    texts = [("a", "b", "a"), ("a", "b")]
    assert distinct(texts, 1) == pytest.approx(2 / 5)
    assert distinct(texts, 2) == pytest.approx(2 / 3)
    assert distinct([], 1) == 0


def test_bleu_equals_the_formula_written_out():
    words, reference = tuple("abcd"), tuple("abce")
    precisions = [3 / 4, 2 / 3, 1 / 2, 0.1 / 1]
    assert bleu(words, [reference]) == pytest.approx(math.prod(precisions) ** 0.25)


def test_short_text_gets_a_brevity_penalty():
    assert bleu(tuple("ab"), [tuple("abcd")], n=1) == pytest.approx(math.exp(1 - 4 / 2))


@given(TEXTS)
def test_self_bleu_lies_between_unrelated_texts_and_copies(texts):
    assert 0 <= self_bleu(texts) <= 1 + 1e-9
    assert self_bleu([texts[0]] * 3) == pytest.approx(1)


@given(st.lists(st.sampled_from("abcd"), min_size=2, max_size=20))
def test_entropy_is_greatest_if_all_values_differ(values):
    assert -1e-9 <= normalised_entropy(values) <= 1 + 1e-9
    assert normalised_entropy(range(len(values))) == pytest.approx(1)
    assert normalised_entropy([1] * len(values)) == 0


def test_only_the_later_text_counts_as_near_duplicate():
    texts = [("put", "the", "apple", "away")] * 2 + [("open", "a", "window")]
    assert near_duplicates(texts) == pytest.approx(1 / 3)


def test_names_are_whole_words():
    assert named_share(
        ["Mia asks for tea.", "Miami is warm.", "For Mia's mother."], ["Mia"]
    ) == pytest.approx(2 / 3)
    assert named_share(["Mia asks."], []) == 0


def test_templates_are_less_diverse_than_free_text():
    templates = [
        f"Put the {thing} in the fridge." for thing in ("apple", "pear", "plate", "mug", "plum", "bowl")
    ]
    talk = [
        "Ann is cooking: freeze the pear.",
        "Before Bo leaves, shut every window in the hall.",
        "Could you carry Cy's mug over to the sink?",
        "Next on the list of Dee: a lamp that is off.",
    ]
    names = ["Ann", "Bo", "Cy", "Dee"]
    plain = diversity({"home": templates}, ["inside(apple,fridge)"] * 6, names)
    social = diversity(
        {"home": talk}, ["frozen(pear)", "not open(window)", "ontop(mug,sink)", "off(lamp)"], names
    )
    assert social["self_bleu4"] < 0.1 < 0.2 < plain["self_bleu4"]
    assert social["distinct_2"] > plain["distinct_2"]
    assert (social["named_share"], plain["named_share"]) == (1, 0)
    assert social["signature_entropy"] > plain["signature_entropy"]
