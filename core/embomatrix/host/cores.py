"""How many cores this process may keep busy."""

from __future__ import annotations

import os

from embomatrix.host.cgroup import Limits, find_limits


def usable_cores(limits: Limits | None = None) -> int:
    """By its affinity, and by the quota of its control groups, rounded down: in a container of two cores two, whatever the
    machine has. ``limits`` are this process's own where none are given."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min(allowed, (limits or find_limits()).cores)))
