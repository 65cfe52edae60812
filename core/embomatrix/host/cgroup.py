"""What the control groups of this process leave it of the machine: a container or a systemd slice may have less than all.

The files are those of version 2, and of version 1 for the processor and memory controllers: Linux, Documentation/admin-guide/
cgroup-v2.rst and cgroup-v1/.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

MOUNT: Final = Path("/sys/fs/cgroup")
MEMBERSHIP: Final = Path("/proc/self/cgroup")
MIB: Final = 1024 * 1024
UNLIMITED_BYTES: Final = 2**60
"""Version 1 writes "no limit" as the largest multiple of a page that fits, which nobody has."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Infinite where nothing is limited. ``memory_mb`` is what may still be taken beyond what is used now."""

    cores: float = math.inf
    memory_mb: float = math.inf


def find_limits(mount: Path = MOUNT, membership: Path = MEMBERSHIP) -> Limits:
    """The tightest limits of this process's groups and of those around them. No groups here: no limits."""
    cores = memory_mb = math.inf
    for folder in _folders(mount, membership):
        cores = min(cores, _cores(folder))
        memory_mb = min(memory_mb, _memory_mb(folder))
    return Limits(cores, memory_mb)


def _folders(mount: Path, membership: Path) -> Iterator[Path]:
    """Of each group and of all around it. Inside a container the mount may begin at the group itself."""
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
    """Bytes by name in the group's account; 0 where it has none. Files read long ago count as used there, though the system
    drops them whenever memory is wanted."""
    words = _words(folder / "memory.stat")
    return int(words[words.index(name) + 1]) if name in words else 0


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
