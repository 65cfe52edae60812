"""Bounded folder of bundles that keeps needed ones."""

import hashlib
import os
import zlib

import pytest
from tests.fakes.manager import chunks_of

from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.rpc.status import OverloadedError

SIZE = 1000


class Folder:
    """Store with room for three bundles, and its clock. A letter names a bundle."""

    def __init__(self, path, keep_s=60.0):
        self.now_s = 1_000_000.0
        self.needed = set()
        self.path = path
        self.store = BundleStore(path, total_bytes=3 * SIZE, keep_s=keep_s, clock=lambda: self.now_s)
        self.store.protect(lambda: {digest_of(name) for name in self.needed})

    async def put(self, name, after_s=100.0):
        self.now_s += after_s

        async def chunks():
            for chunk in chunks_of(content_of(name)):
                yield chunk

        await self.store.put(digest_of(name), chunks())

    def there(self):
        return "".join(name for name in "abcdef" if (self.path / file_of(name)).exists())


def content_of(name):
    return zlib.compress(name.encode() * (SIZE - 11), level=0)


def digest_of(name):
    return f"sha256:{hashlib.sha256(content_of(name)).hexdigest()}"


def file_of(name):
    return f"{digest_of(name).removeprefix('sha256:')}.bundle"


@pytest.fixture
async def full(tmp_path):
    folder = Folder(tmp_path)
    for name in "abc":
        await folder.put(name)
    return folder


async def test_full_folder_deletes_the_least_recently_used(full):
    await full.put("d")
    assert full.there() == "bcd"


async def test_requested_bundle_counts_as_used(full):
    full.now_s += 50
    assert full.store.missing([digest_of("a"), digest_of("f")]) == [digest_of("f")]
    await full.put("d")
    assert full.there() == "acd"


async def test_fetched_bundle_counts_as_used(full):
    full.now_s += 50
    assert b"".join([chunk async for chunk in full.store.get(digest_of("a"))]) == content_of("a")
    await full.put("d")
    assert full.there() == "acd"


async def test_needed_bundles_are_never_deleted(full):
    full.needed = {"a", "b"}
    await full.put("d")
    await full.put("e")
    assert full.there() == "abe"


async def test_folder_full_of_needed_bundles_refuses_new_ones(full):
    full.needed = set("abc")
    with pytest.raises(OverloadedError, match="needed or were used recently"):
        await full.put("d")
    assert full.there() == "abc"
    full.needed = set()
    await full.put("d")
    assert full.there() == "bcd"


async def test_recently_used_bundles_are_not_deleted(full):
    await full.put("d", after_s=0.0)
    await full.put("e", after_s=0.0)
    with pytest.raises(OverloadedError):
        await full.put("f", after_s=0.0)
    assert full.there() == "cde"


async def test_another_upload_may_end_while_room_is_made(full, monkeypatch):
    scan = os.scandir

    def during_another_upload(folder):
        incoming = full.path / "incoming-other"
        incoming.write_bytes(b"half")
        entries = list(scan(folder))
        incoming.rename(full.path / "other.bundle")
        return iter(entries)

    monkeypatch.setattr("embomatrix.manager.runtime.bundles.os.scandir", during_another_upload)
    await full.put("d")
    assert full.there() == "bcd"


async def test_incomplete_files_are_deleted_at_start(tmp_path):
    old, young = tmp_path / "incoming-old", tmp_path / "incoming-young"
    for path, at_s in ((old, 1_000_000.0 - 3600), (young, 1_000_000.0 - 1)):
        path.write_bytes(b"half")
        os.utime(path, (at_s, at_s))
    Folder(tmp_path)
    assert (old.exists(), young.exists()) == (False, True)
