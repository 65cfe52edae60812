"""Limits of this process on its host: cores and memory left by control groups and CPU affinity.

The files are those of version 2, and of version 1 for the processor and memory controllers: Linux, Documentation/admin-guide/
cgroup-v2.rst and cgroup-v1/.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MOUNT: Final = Path("/sys/fs/cgroup")
MEMBERSHIP: Final = Path("/proc/self/cgroup")
MIB: Final = 1024 * 1024
UNLIMITED_BYTES: Final = 2**60
"""Version 1 writes "no limit" as the largest multiple of the page size."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits by control groups, infinite if there are none. ``memory_mb`` is the memory that is still free."""

    cores: float = math.inf
    memory_mb: float = math.inf


def find_limits(mount: Path = MOUNT, membership: Path = MEMBERSHIP) -> Limits:
    """Return the tightest limits of this process's control groups and their parents."""
    cores = memory_mb = math.inf
    for folder in _folders(mount, membership):
        cores = min(cores, _cores(folder))
        memory_mb = min(memory_mb, _memory_mb(folder))
    return Limits(cores, memory_mb)


def _folders(mount: Path, membership: Path) -> Iterator[Path]:
    """Yield the folders of each group and its parents. In a container the mount may start at the group itself."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        roots = [mount / name for name in {controllers, *controllers.split(",")}] if controllers else [mount]
        for root in roots:
            inner = Path(path.lstrip("/"))
            yield from (root / part for part in (inner, *inner.parents))


def _cores(folder: Path) -> float:
    words = _words(folder / "cpu.max")
    if len(words) != 2:
        words = _words(folder / "cpu.cfs_quota_us") + _words(folder / "cpu.cfs_period_us")
    if len(words) != 2 or words[0] in {"max", "-1"}:
        return math.inf
    return int(words[0]) / int(words[1])


def _memory_mb(folder: Path) -> float:
    for limit_name, used_name, file_name in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        limit, used = _words(folder / limit_name), _words(folder / used_name)
        if limit and used and limit[0] != "max" and int(limit[0]) < UNLIMITED_BYTES:
            held = int(used[0]) - _stat(folder, file_name)
            return max(0.0, (int(limit[0]) - held) / MIB)
    return math.inf


def _stat(folder: Path, name: str) -> int:
    """Return the bytes under a name in the group's account, or 0. The account counts inactive page cache as used, although the
    kernel drops it on demand."""
    words = _words(folder / "memory.stat")
    return int(words[words.index(name) + 1]) if name in words else 0


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []


def usable_cores(limits: Limits | None = None) -> int:
    """Return the cores that this process may keep busy, by affinity and control groups, rounded down.

    ``limits`` default to this process's own.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min(allowed, (limits or find_limits()).cores)))
