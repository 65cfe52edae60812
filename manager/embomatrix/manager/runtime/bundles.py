"""Bundles on disk, each named after the digest of its content."""

import asyncio
import contextlib
import hashlib
import logging
import os
import re
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import IO, Final

from embomatrix.rpc.channel import CHUNK_BYTES
from embomatrix.rpc.status import InvalidRequestError, NotFoundError, OverloadedError
from embomatrix.world.bundle_head import read_profiles
from embomatrix.world.inflation import BundleError, Inflation
from embomatrix.world.task import Profile

logger = logging.getLogger(__name__)

PREFIX: Final = "sha256:"
INCOMING: Final = "incoming-"
"""Prefix of the names of incomplete files."""
TASKS_KEPT: Final = 50_000
"""Tasks of bundles that stay in memory, of less than 1 kB each. Those of the oldest bundle are forgotten first."""
_DIGEST: Final = re.compile(r"sha256:[0-9a-f]{64}")


class BundleStore:
    """Folder of bundles, bounded by ``total_bytes``.

    When it is full, bundles that no run needs and that were unused for ``keep_s`` seconds are deleted, least recently
    used first. The modification time of a file is its last use; ``clock`` returns seconds of the same clock.
    """

    def __init__(
        self,
        folder: Path,
        *,
        total_bytes: int,
        keep_s: float = 600.0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._folder = folder
        self._total_bytes = total_bytes
        self._keep_s = keep_s
        self._clock = clock
        self._needed: Callable[[], AbstractSet[str]] = frozenset
        self._profiles: dict[str, Mapping[str, Profile]] = {}
        self._reading = asyncio.Lock()
        folder.mkdir(parents=True, exist_ok=True)
        for left_over in folder.glob(f"{INCOMING}*"):
            if clock() - left_over.stat().st_mtime > keep_s:
                left_over.unlink(missing_ok=True)

    def protect(self, needed: Callable[[], AbstractSet[str]]) -> None:
        """Protect the bundles whose digests this function returns."""
        self._needed = needed

    def has(self, digest: str) -> bool:
        """Return True if the bundle is present. It then counts as used."""
        now_s = self._clock()
        try:
            os.utime(self._path(digest), (now_s, now_s))
        except FileNotFoundError:
            return False
        return True

    def missing(self, digests: list[str]) -> list[str]:
        """Return the digests of bundles that are absent, in the same order."""
        return [digest for digest in dict.fromkeys(digests) if not self.has(digest)]

    async def profiles(self, digests: Iterable[str]) -> Mapping[str, Mapping[str, Profile]]:
        """Return the tasks of the bundles that are present and readable: the profile of each by task id.

        Bundles are read one at a time: each may take as much memory as three times its content.
        """
        found = {}
        for digest in dict.fromkeys(digests):
            # Absent bundles are reported by ``missing``, unreadable ones by the workers that load them.
            with contextlib.suppress(OSError, BundleError):
                found[digest] = await self._profiles_of(digest)
        return found

    async def _profiles_of(self, digest: str) -> Mapping[str, Profile]:
        if digest in self._profiles:
            return self._profiles[digest]
        async with self._reading:
            if digest not in self._profiles:
                self._keep_profiles(digest, await asyncio.to_thread(read_profiles, self._path(digest)))
            return self._profiles[digest]

    def _keep_profiles(self, digest: str, tasks: Mapping[str, Profile]) -> None:
        kept = len(tasks) + sum(map(len, self._profiles.values()))
        while self._profiles and kept > TASKS_KEPT:
            kept -= len(self._profiles.pop(next(iter(self._profiles))))
        self._profiles[digest] = tasks

    async def missing_or_damaged(self, digests: list[str]) -> list[str]:
        """Return the digests of bundles that are absent or damaged. Damaged files are deleted."""
        known = dict.fromkeys(digests)
        return await asyncio.to_thread(lambda: [digest for digest in known if not self._is_sound(digest)])

    async def put(self, digest: str, chunks: AsyncIterator[bytes]) -> None:
        """Store a bundle. It gets its name only when it is complete and its digest is right.

        Raises InvalidRequestError at the first chunk that a worker would reject.
        """
        path = self._path(digest)
        try:
            await self._take(digest, path, chunks)
        except BundleError as error:
            raise InvalidRequestError(f"bundle {digest} is refused: {error}") from error
        except OSError as error:
            raise OverloadedError(
                f"the bundle folder {self._folder} can't be written ({error.strerror}): make room on the manager's disk"
            ) from error

    async def _take(self, digest: str, path: Path, chunks: AsyncIterator[bytes]) -> None:
        handle, name = tempfile.mkstemp(prefix=INCOMING, dir=self._folder)
        sha, size, inflation = hashlib.sha256(), 0, Inflation()
        try:
            with os.fdopen(handle, "wb") as file:
                async for chunk in chunks:
                    size += len(chunk)
                    sha.update(chunk)
                    await asyncio.to_thread(_check_and_write, inflation, chunk, file)
            found = PREFIX + sha.hexdigest()
            if found != digest:
                raise InvalidRequestError(
                    f"the bundle's content has digest {found}, expected {digest}: it was damaged in transit, or misnamed"
                )
            inflation.finish()
            await asyncio.to_thread(self._make_room, size, self._needed())
            os.replace(name, path)
            self.has(digest)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(name)

    async def get(self, digest: str) -> AsyncIterator[bytes]:
        """Yield the bundle in chunks. Raises NotFoundError for an absent bundle."""
        path = self._path(digest)
        if not self.has(digest):
            raise NotFoundError(f"the manager has no bundle {digest}: upload it first")
        with path.open("rb") as file:
            while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
                yield chunk

    def _is_sound(self, digest: str) -> bool:
        path = self._path(digest)
        try:
            with path.open("rb") as file:
                found = PREFIX + hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            return False
        self.has(digest)
        if found != digest:
            logger.warning("bundle damaged on disk, removed bundle=%s found=%s", digest, found)
            path.unlink(missing_ok=True)
        return found == digest

    def _make_room(self, size: int, needed: AbstractSet[str]) -> None:
        """Delete bundles until the folder, with the incoming bundle of ``size`` bytes, is within its bound."""
        files: dict[str, os.stat_result] = {}
        for entry in os.scandir(self._folder):
            with contextlib.suppress(FileNotFoundError):  # another bundle got its name meanwhile
                if entry.is_file():
                    files[entry.name] = entry.stat()
        used = sum(found.st_size for found in files.values())
        kept = {self._path(digest).name for digest in needed}
        before_s = self._clock() - self._keep_s
        for name, found in sorted(files.items(), key=lambda item: item[1].st_mtime):
            if used <= self._total_bytes or found.st_mtime >= before_s:
                break
            if name in kept or name.startswith(INCOMING):
                continue
            (self._folder / name).unlink(missing_ok=True)
            used -= found.st_size
            logger.info("bundle deleted to make room bundle=%s", name)
        if used > self._total_bytes:
            raise OverloadedError(
                f"the bundle folder {self._folder} holds {used} of {self._total_bytes} bytes and has no room for {size} "
                "more; all others are needed or were used recently: try again later, raise bundle_total_mb, or close runs"
            )

    def _path(self, digest: str) -> Path:
        if not _DIGEST.fullmatch(digest):
            raise InvalidRequestError(
                f"{digest[:100]!r} is not a digest: expected sha256: and 64 hexadecimal digits"
            )
        return self._folder / f"{digest.removeprefix(PREFIX)}.bundle"


def _check_and_write(inflation: Inflation, chunk: bytes, file: IO[bytes]) -> None:
    """Check the chunk's decompressed size, then write it. The decompressed data is discarded."""
    for _ in inflation.feed(chunk):
        pass
    file.write(chunk)
