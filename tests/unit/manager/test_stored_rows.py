"""Rows of the state store that are damaged, or of another version, are refused in a sentence."""

import pytest

from embomatrix.manager.access.gate import Gate
from embomatrix.manager.runtime.serialization import (
    announced_in,
    batch_of,
    group_and_kind,
    reputation_of,
    terms_of,
)
from embomatrix.manager.store.protocol import (
    BatchRow,
    Namespace,
    NamespaceRow,
    ResultRow,
    RunRow,
    StateError,
    readable,
)
from embomatrix.manager.store.redis import _row
from embomatrix.manager.store.sqlite import SqliteStore

DAMAGED = b"\xff\xff\xff"
READERS = {
    "batch 'b1' of run 'r1'": lambda data: batch_of(BatchRow("r1", "b1", "", data)),
    "result of rollout 'x1'": lambda data: group_and_kind(ResultRow(1, "x1", data)),
    "reputation of worker 'w1'": lambda data: reputation_of(NamespaceRow("w1", data)),
    "window of run 'r1'": lambda data: announced_in(NamespaceRow("r1", data)),
    "terms of run 'r1'": lambda data: terms_of(RunRow("r1", "", data)),
}


@pytest.mark.parametrize("name", READERS)
def test_damaged_row_is_named_with_the_remedy(name):
    with pytest.raises(StateError, match=rf"{name} in the state store can't be read .*; restore the store"):
        READERS[name](DAMAGED)


@pytest.mark.parametrize(
    "fields", [b'{"taken": "3"}', b'{"unknown": 1}', b"[]", b"[" * 100_000, b'{"quarantine": "\\ud800"}', b""]
)
def test_reputation_with_other_fields_or_types_is_refused(fields):
    with pytest.raises(StateError, match="worker 'w1'"):
        reputation_of(NamespaceRow("w1", fields))


@pytest.mark.parametrize(
    "fields",
    [
        b"{",
        b'{"token_id": "t1", "role": "king", "secret_hash": ""}',
        b'{"token_id": "t1", "role": "admin", "secret_hash": 3}',
        b'{"token_id": "t1", "role": "admin", "secret_hash": "", "unknown": 1}',
    ],
)
async def test_credential_with_other_fields_or_types_opens_no_gate(fields):
    store = SqliteStore(f"file:{__name__}{hash(fields)}?mode=memory&cache=shared")
    store._db.execute("INSERT INTO shelf VALUES (?, 't1', ?)", (Namespace.CREDENTIALS.value, fields))
    with pytest.raises(StateError, match="the credential 't1' in the state store can't be read"):
        await Gate(store, guarded=True).open()
    await store.close()


@pytest.mark.parametrize("member", [b"", b"x", b"2:\xff\xff"])
def test_garbled_result_in_redis_is_named_with_the_remedy(member):
    with pytest.raises(StateError, match="a result in the state store can't be read"), readable("a result"):
        _row(1, member)
