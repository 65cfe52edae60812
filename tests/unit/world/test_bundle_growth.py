"""Bundles whose JSON and arrays would become far more memory than their bytes."""

import json
import struct
import tracemalloc
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fuzz.worst_bundle import KINDS, bundle_with, measured, worst

from embomatrix.world.bundle import decode_bundle
from embomatrix.world.bundle_head import FORMAT, MAGIC
from embomatrix.world.inflation import BundleError, BundleLimits, check_values

MOST_MB = 200


def bundle_of(text):
    """Return a bundle with this JSON text and no arrays."""
    head = struct.calcsize("<4sII")
    text += b" " * (-(head + len(text)) % 64)
    return zlib.compress(struct.pack("<4sII", MAGIC, FORMAT, len(text)) + text, 1)


@pytest.mark.parametrize(
    "value", [b"{}", b"[]", b"0", b"null", b'{"name":"a"}', b"[[[]]]", b'{"a":{"b":{}}}'], ids=bytes.decode
)
@pytest.mark.parametrize("field", [b"tasks", b"arrays", b"poses", b"anything"])
def test_memory_of_a_hostile_bundle_is_bounded(value, field):
    count = 8_000_000 // (len(value) + 1)
    data = bundle_of(b'{"%s":[' % field + b",".join([value] * count) + b"]}")
    tracemalloc.start()
    try:
        with pytest.raises(BundleError, match=r"values: expected at most 400,000|grows beyond"):
            decode_bundle(data)
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak_mb < MOST_MB


@pytest.mark.parametrize(
    "mixture",
    [
        {"poses": 1_000_000},
        {"boxes": 400_000},
        {"one goal": 300_000},
        {"characters": 60_000_000},
        {"described arrays": 130_000},
        # the worst that `tests.fuzz.worst_bundle` found within the limits
        {"abilities": 98_304, "characters": 14_900_000},
        {"barred": 98_304, "boxes": 98_304},
    ],
    ids=lambda mixture: " and ".join(mixture),
)
def test_memory_of_a_bundle_with_very_many_elements_is_bounded(mixture):
    assert measured(mixture).peak_mb < MOST_MB


@pytest.mark.parametrize("kind", KINDS)
def test_search_for_the_worst_bundle_adds_elements_of_every_kind(kind):
    assert measured({kind: 50}).accepted
    assert len(bundle_with({kind: 50})) > len(bundle_with({}))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_memory_of_the_worst_bundle_that_a_search_finds_is_bounded():
    found = worst(6)
    assert found.accepted
    assert found.peak_mb < MOST_MB, found


@given(
    st.recursive(
        st.integers() | st.text(max_size=5),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(max_size=3), inner),
    )
)
def test_count_covers_every_value_of_a_text(value):
    def values(one):
        if isinstance(one, dict):
            return 1 + sum(map(values, one.values()))
        return 1 + sum(map(values, one)) if isinstance(one, list) else 1

    text = json.dumps(value).encode()
    check_values(text, BundleLimits(values=10**6))
    with pytest.raises(BundleError):
        check_values(text, BundleLimits(values=values(value) // 2 - 1))
