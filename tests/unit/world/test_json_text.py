"""JSON text becomes a value or raises ValueError, whatever it contains."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.world.json_text import parse_json

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=10,
)


@given(VALUES, st.booleans())
def test_any_value_is_read_back_from_its_text(value, ascii_only):
    text = json.dumps(value, ensure_ascii=ascii_only)
    assert parse_json(text) == value
    assert parse_json(text.encode()) == value


@pytest.mark.parametrize("opening", ["[", '{"a":', '[{"a":['])
def test_deep_nesting_is_a_value_error(opening):
    with pytest.raises(ValueError, match="nested too deep"):
        parse_json(opening * 100_000)


@pytest.mark.parametrize("escape", [r"\ud800", r"\uDfff", r"\ude00\ud83d", r"a\ud83d"])
@pytest.mark.parametrize("form", ['"{}"', '["{}"]', '{{"{}": 1}}'])
def test_half_of_a_surrogate_pair_is_a_value_error(escape, form):
    with pytest.raises(ValueError, match="half of a surrogate pair"):
        parse_json(form.format(escape))


def test_whole_surrogate_pairs_are_characters():
    assert parse_json(r'"\ud83d\ude00"') == "😀"


@pytest.mark.parametrize("data", [b"\xed\xa0\x80", b'"\xff"', b"", b'"\xed\xa0\x80"', b"\xef\xbb\xbf1"])
def test_bytes_that_are_no_text_are_a_value_error(data):
    with pytest.raises(ValueError):
        parse_json(data)
