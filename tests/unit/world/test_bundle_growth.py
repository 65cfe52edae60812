"""Bundles whose JSON would become far more memory than its bytes."""

import json
import struct
import tracemalloc
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.world.bundle import decode_bundle
from embomatrix.world.bundle_head import FORMAT, MAGIC
from embomatrix.world.inflation import BundleError, BundleLimits, check_values

MOST_MB = 200


def bundle_with(text):
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
    data = bundle_with(b'{"%s":[' % field + b",".join([value] * count) + b"]}")
    tracemalloc.start()
    try:
        with pytest.raises(BundleError, match=r"values: expected at most 400,000|grows beyond"):
            decode_bundle(data)
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak_mb < MOST_MB


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
