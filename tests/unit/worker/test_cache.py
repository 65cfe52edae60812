"""Bundles on disk: what is there is not fetched, what is damaged is fetched again, what is old goes."""

import os

import pytest

from embomatrix.rpc.values import InfraCode
from embomatrix.worker.cache import BundleCache
from embomatrix.worker.residents import LoadError
from embomatrix.world.bundle import bundle_digest


class Source:
    """Bundles by digest, and a record of what was asked for."""

    def __init__(self, *contents, wrong=0):
        self.bundles = {bundle_digest(content): content for content in contents}
        self.asked = []
        self._wrong = wrong

    async def fetch(self, digest):
        self.asked.append(digest)
        if len(self.asked) <= self._wrong:
            return b"something else"
        return self.bundles[digest]


def _cache(folder, source, limit_bytes=10_000):
    return BundleCache(folder / "bundles", limit_bytes=limit_bytes, fetch=source.fetch)


async def test_a_bundle_is_fetched_once_and_then_found(tmp_path):
    source = Source(b"scene")
    cache = _cache(tmp_path, source)
    [digest] = source.bundles
    first = await cache.path_of(digest)
    assert await cache.path_of(digest) == first
    assert first.read_bytes() == b"scene"
    assert source.asked == [digest]


async def test_a_bundle_damaged_on_disk_is_fetched_again(tmp_path):
    source = Source(b"scene")
    cache = _cache(tmp_path, source)
    [digest] = source.bundles
    path = await cache.path_of(digest)
    path.write_bytes(b"scne")
    assert (await cache.path_of(digest)).read_bytes() == b"scene"
    assert len(source.asked) == 2


async def test_a_bundle_damaged_on_its_way_twice_is_given_up(tmp_path):
    source = Source(b"scene", wrong=2)
    with pytest.raises(LoadError, match="fetched twice") as caught:
        await _cache(tmp_path, source).path_of(next(iter(source.bundles)))
    assert caught.value.code is InfraCode.BUNDLE_CORRUPT
    assert len(source.asked) == 2


@pytest.mark.parametrize("digest", ["", "sha256:xyz", "../../etc/passwd", "sha256:" + "0" * 63])
async def test_what_is_no_digest_is_never_a_path(tmp_path, digest):
    source = Source()
    with pytest.raises(LoadError, match="is no digest"):
        await _cache(tmp_path, source).path_of(digest)
    assert source.asked == []


async def test_the_longest_unused_bundles_go_when_the_disk_is_full(tmp_path):
    source = Source(b"a" * 400, b"b" * 400, b"c" * 400)
    cache = _cache(tmp_path, source, limit_bytes=1000)
    oldest, middle, newest = source.bundles
    for age, digest in enumerate((oldest, middle)):
        path = await cache.path_of(digest)
        os.utime(path, (age, age))
    await cache.path_of(oldest)
    await cache.path_of(newest)
    names = {path.name for path in (tmp_path / "bundles").iterdir()}
    assert names == {digest.removeprefix("sha256:") + ".bundle" for digest in (oldest, newest)}
