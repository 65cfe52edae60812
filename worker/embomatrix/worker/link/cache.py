"""Bundle cache on disk by digest: verified at every use, bounded in size, evicted by last use."""

import asyncio
import contextlib
import errno
import logging
import os
import re
import secrets
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

from embomatrix.host.limits import MIB
from embomatrix.rpc.wire.values import InfraCode
from embomatrix.worker.slots.residents import LoadError
from embomatrix.world.inflation import bundle_digest

logger = logging.getLogger(__name__)

_DIGEST: Final = re.compile(r"sha256:[0-9a-f]{64}")
SUFFIX: Final = ".bundle"
PART: Final = ".part-"
ABANDONED_S: Final = 3600.0
"""Age after which a partial file counts as left by a killed daemon."""
FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class BundleCache:
    """Bundle files of one folder, which several daemons may share and which outlives them.

    ``fetch`` returns a bundle's bytes from the manager, or raises LoadError.
    """

    def __init__(self, folder: Path, *, limit_bytes: int, fetch: Callable[[str], Awaitable[bytes]]) -> None:
        self._folder = folder
        self._limit_bytes = limit_bytes
        self._fetch = fetch

    async def path_of(self, digest: str) -> Path:
        """Return the bundle's file, fetched if it is missing. Raise LoadError (bundle_corrupt) if it is damaged twice."""
        if not _DIGEST.fullmatch(digest):
            raise LoadError(
                InfraCode.BUNDLE_CORRUPT,
                f"{digest!r} is not a digest: expected sha256: and 64 hexadecimal digits",
            )
        cached = await asyncio.to_thread(self._find, digest)
        if cached is not None:
            return cached
        for _ in range(2):
            data = await self._fetch(digest)
            found = await asyncio.to_thread(bundle_digest, data)
            if found == digest:
                return await asyncio.to_thread(self._keep, digest, data)
            logger.warning("bundle damaged in transit bundle=%s found=%s", digest, found)
        raise LoadError(
            InfraCode.BUNDLE_CORRUPT,
            f"the bundle was fetched twice with a wrong digest, last {found}: expected {digest}",
        )

    def _path(self, digest: str) -> Path:
        return self._folder / (digest.removeprefix("sha256:") + SUFFIX)

    def _find(self, digest: str) -> Path | None:
        path = self._path(digest)
        try:
            if bundle_digest(path.read_bytes()) == digest:
                # The time of last use orders evictions.
                os.utime(path)
                return path
        except FileNotFoundError:
            return None
        logger.warning("bundle damaged on disk, fetching it again bundle=%s", digest)
        path.unlink(missing_ok=True)
        return None

    def _keep(self, digest: str, data: bytes) -> Path:
        path = self._path(digest)
        self._folder.mkdir(parents=True, exist_ok=True)
        # Written beside and renamed: a killed daemon leaves no partial bundle under the digest's name.
        part = path.with_suffix(f"{PART}{os.getpid()}-{secrets.token_hex(4)}")
        try:
            self._write(part, data)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        self._evict(keep=path, limit_bytes=self._limit_bytes)
        return path

    def _write(self, part: Path, data: bytes) -> None:
        """Write the file; on a full disk evict all other bundles and try once more."""
        try:
            part.write_bytes(data)
        except OSError as error:
            if error.errno not in FULL:
                raise
            logger.warning("the disk is full: evicting all other bundles folder=%s", self._folder)
            self._evict(keep=part, limit_bytes=0)
            part.write_bytes(data)

    def used_mb(self) -> float:
        """Disk space of the bundles in MB."""
        return round(sum(size for _, size, _ in self._files()) / MIB, 1)

    def _evict(self, *, keep: Path, limit_bytes: int) -> None:
        files = sorted(self._files(), key=lambda file: file[2])
        total = sum(size for _, size, _ in files)
        for path, size, used_s in files:
            abandoned = PART in path.name and time.time() - used_s > ABANDONED_S
            if abandoned or (total > limit_bytes and path != keep and PART not in path.name):
                path.unlink(missing_ok=True)
                total -= size

    def _files(self) -> list[tuple[Path, int, float]]:
        """Bundle files and partial files, each with its size in bytes and the wall time of its last use."""
        files = []
        for path in self._folder.glob("*"):
            if path.suffix == SUFFIX or PART in path.name:
                # Another daemon may have removed it meanwhile.
                with contextlib.suppress(FileNotFoundError):
                    stat = path.stat()
                    files.append((path, stat.st_size, stat.st_mtime))
        return files
