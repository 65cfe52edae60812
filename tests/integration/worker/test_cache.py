"""Bundle cache: known bundles are not fetched, damaged ones are fetched again, old ones are evicted."""

import asyncio
import os
import resource
import shutil
import signal
import subprocess
import sys

import pytest

from embomatrix.rpc.wire.values import InfraCode
from embomatrix.worker.link.cache import BundleCache
from embomatrix.worker.slots.residents import LoadError
from embomatrix.world.inflation import bundle_digest


class Source:
    """Bundles by digest, and a record of the requests."""

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


async def test_bundle_is_fetched_once_and_then_cached(tmp_path):
    source = Source(b"scene")
    cache = _cache(tmp_path, source)
    [digest] = source.bundles
    first = await cache.path_of(digest)
    assert await cache.path_of(digest) == first
    assert first.read_bytes() == b"scene"
    assert source.asked == [digest]


async def test_bundle_damaged_on_disk_is_fetched_again(tmp_path):
    source = Source(b"scene")
    cache = _cache(tmp_path, source)
    [digest] = source.bundles
    path = await cache.path_of(digest)
    path.write_bytes(b"scne")
    assert (await cache.path_of(digest)).read_bytes() == b"scene"
    assert len(source.asked) == 2


async def test_bundle_damaged_in_transit_twice_is_given_up(tmp_path):
    source = Source(b"scene", wrong=2)
    with pytest.raises(LoadError, match="fetched twice") as caught:
        await _cache(tmp_path, source).path_of(next(iter(source.bundles)))
    assert caught.value.code is InfraCode.BUNDLE_CORRUPT
    assert len(source.asked) == 2


@pytest.mark.parametrize("digest", ["", "sha256:xyz", "../../etc/passwd", "sha256:" + "0" * 63])
async def test_invalid_digest_never_becomes_a_path(tmp_path, digest):
    source = Source()
    with pytest.raises(LoadError, match="is not a digest"):
        await _cache(tmp_path, source).path_of(digest)
    assert source.asked == []


async def test_least_recently_used_bundles_are_evicted_at_the_limit(tmp_path):
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


async def test_reopened_cache_fetches_no_known_bundle(tmp_path):
    source = Source(b"scene", b"other")
    for digest in source.bundles:
        await _cache(tmp_path, source).path_of(digest)
    later = Source()
    for digest in source.bundles:
        assert (await _cache(tmp_path, later).path_of(digest)).read_bytes() == source.bundles[digest]
    assert later.asked == []


async def test_two_daemons_share_a_cache_folder(tmp_path):
    contents = [bytes([number]) * 400 for number in range(8)]
    sources = [Source(*contents), Source(*contents)]
    caches = [_cache(tmp_path, source, limit_bytes=1300) for source in sources]

    async def fetch_all(cache, digests):
        for digest in digests:
            assert (await cache.path_of(digest)).suffix == ".bundle"

    digests = list(sources[0].bundles)
    await asyncio.gather(fetch_all(caches[0], digests * 3), fetch_all(caches[1], digests[::-1] * 3))
    left = list((tmp_path / "bundles").iterdir())
    assert all(bundle_digest(path.read_bytes()).endswith(path.stem) for path in left)
    assert sum(path.stat().st_size for path in left) <= 1300


async def test_old_partial_files_of_a_killed_daemon_are_removed(tmp_path):
    source = Source(b"scene")
    cache = _cache(tmp_path, source)
    (tmp_path / "bundles").mkdir()
    old, young = tmp_path / "bundles" / "a.part-1-x", tmp_path / "bundles" / "b.part-2-y"
    old.write_bytes(b"half")
    young.write_bytes(b"half")
    os.utime(old, (0, 0))
    await cache.path_of(next(iter(source.bundles)))
    assert (old.exists(), young.exists()) == (False, True)


SMALL_DISK = """
import asyncio, sys
from pathlib import Path
from embomatrix.worker.link.cache import BundleCache
from embomatrix.world.inflation import bundle_digest

bundles = {bundle_digest(content): content for content in (b"a" * 30_000, b"b" * 30_000, b"c" * 30_000)}

async def fetch(digest):
    return bundles[digest]

async def main():
    cache = BundleCache(Path(sys.argv[1]), limit_bytes=10**9, fetch=fetch)
    paths = [await cache.path_of(digest) for digest in bundles]
    print(*(path.exists() for path in paths), len(list(Path(sys.argv[1]).iterdir())))

asyncio.run(main())
"""
ON_SMALL_DISK = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")
MOUNT = 'mount -t tmpfs -o size=72k none "$0"'


def _small_disks():
    """Return whether this system allows mounting a small disk."""
    command = (*ON_SMALL_DISK, MOUNT, "/mnt")
    return (
        shutil.which("unshare") is not None
        and not subprocess.run(command, capture_output=True, check=False).returncode
    )


@pytest.mark.skipif(not _small_disks(), reason="needs a user namespace")
def test_full_disk_evicts_all_other_bundles(tmp_path):
    command = (
        *ON_SMALL_DISK,
        f'{MOUNT} && exec "$1" -c "$2" "$0"',
        str(tmp_path),
        sys.executable,
        SMALL_DISK,
    )
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert result.stdout == "False False True 1\n", result.stderr


async def test_failed_bundle_write_leaves_no_file(tmp_path):
    # The process's own file size limit, lifted again below.
    source = Source(b"a" * 400, b"b" * 4000)
    cache = _cache(tmp_path, source)
    small, large = source.bundles
    kept = await cache.path_of(small)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            await cache.path_of(large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert [path.name for path in (tmp_path / "bundles").iterdir()] == [kept.name]
    assert (await cache.path_of(large)).read_bytes() == b"b" * 4000
