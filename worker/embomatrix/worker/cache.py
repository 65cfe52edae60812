"""Bundles on disk, by digest: checked at every use, bounded in size, the longest unused evicted first."""

from __future__ import annotations

import asyncio
import logging
import os
import re
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.values import InfraCode
from embomatrix.worker.residents import LoadError
from embomatrix.world.bundle import bundle_digest

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

logger = logging.getLogger(__name__)

_DIGEST: Final = re.compile(r"sha256:[0-9a-f]{64}")
SUFFIX: Final = ".bundle"


class BundleCache:
    """Brings bundles to disk. ``fetch`` gets a bundle's bytes from the manager and raises LoadError when it can't."""

    def __init__(self, folder: Path, *, limit_bytes: int, fetch: Callable[[str], Awaitable[bytes]]) -> None:
        self._folder = folder
        self._limit_bytes = limit_bytes
        self._fetch = fetch

    async def path_of(self, digest: str) -> Path:
        """The file of this bundle, fetched if need be. Damaged twice in a row, it is a LoadError (bundle_corrupt)."""
        if not _DIGEST.fullmatch(digest):
            raise LoadError(
                InfraCode.BUNDLE_CORRUPT, f"{digest!r} is no digest: expected sha256: and 64 digits"
            )
        cached = await asyncio.to_thread(self._find, digest)
        if cached is not None:
            return cached
        for _ in range(2):
            data = await self._fetch(digest)
            found = bundle_digest(data)
            if found == digest:
                return await asyncio.to_thread(self._keep, digest, data)
            logger.warning("bundle damaged on its way bundle=%s found=%s", digest, found)
        raise LoadError(
            InfraCode.BUNDLE_CORRUPT, f"fetched twice, and twice its digest was another, last {found}"
        )

    def _path(self, digest: str) -> Path:
        return self._folder / (digest.removeprefix("sha256:") + SUFFIX)

    def _find(self, digest: str) -> Path | None:
        path = self._path(digest)
        try:
            if bundle_digest(path.read_bytes()) == digest:
                # The time of last use: evictions go by it.
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
        # Written aside and renamed: a daemon killed in between leaves no half bundle under the digest's name.
        part = path.with_suffix(f".part-{os.getpid()}")
        part.write_bytes(data)
        part.replace(path)
        self._evict(keep=path)
        return path

    def _evict(self, *, keep: Path) -> None:
        files = [(file, file.stat()) for file in self._folder.glob(f"*{SUFFIX}")]
        files.sort(key=lambda item: item[1].st_mtime_ns)
        total = sum(stat.st_size for _, stat in files)
        for file, stat in files:
            if total <= self._limit_bytes:
                break
            if file != keep:
                file.unlink(missing_ok=True)
                total -= stat.st_size
