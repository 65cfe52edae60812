"""CPU time of a benchmark's cluster: inside the slots and outside them."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.bench.report.figures import BenchError

if TYPE_CHECKING:
    from embomatrix.bench.cluster.processes import BenchCluster

TRIES: Final = 100
"""Looks for a slot that executes: between two rollouts none does."""
SLOT_DEPTH: Final = 3
"""Generations from the daemon to a slot: daemon, root, scene, slot."""


@dataclass(frozen=True, slots=True)
class CpuUse:
    """CPU seconds. ``daemons_s`` includes the workers' roots and scenes; ``trainer_s`` is of this process."""

    slots_s: float
    manager_s: float
    daemons_s: float
    trainer_s: float

    @property
    def overhead(self) -> float:
        """Share of all CPU time that was spent outside the slots."""
        outside_s = self.manager_s + self.daemons_s + self.trainer_s
        return outside_s / (outside_s + self.slots_s)


class CpuWatch:
    """CPU time of a cluster since this object was made.

    Looking at the processes costs as much as hundreds of results, so it is left out of this process's own time. Slots that
    have ended are not counted; none ends during undisturbed work.
    """

    def __init__(self, cluster: BenchCluster) -> None:
        self._cluster = cluster
        self._before = _others_s(cluster)
        self._own_s = time.process_time()

    def used(self) -> CpuUse:
        """CPU time until now."""
        own_s = time.process_time() - self._own_s
        others_s = zip(_others_s(self._cluster), self._before, strict=True)
        slots_s, manager_s, daemons_s = (after_s - before_s for after_s, before_s in others_s)
        return CpuUse(slots_s, manager_s, daemons_s, own_s)


def descendants_cpu_s() -> float:
    """CPU seconds of all living descendants of this process."""
    return sum(cpu_s(process) for process, depth in _tree(os.getpid()) if depth)


def cpu_s(process: psutil.Process) -> float:
    """CPU seconds of a process; 0 if it has ended."""
    with contextlib.suppress(psutil.Error):
        times = process.cpu_times()
        return float(times.user + times.system)
    return 0.0


def running_slot(cluster: BenchCluster) -> int:
    """Process id of a slot that executes now. Raise BenchError if there is none."""
    for _ in range(TRIES):
        for worker in cluster.processes[1:]:
            for process, depth in _tree(worker.child.pid):
                with contextlib.suppress(psutil.Error):
                    if depth >= SLOT_DEPTH and process.status() == psutil.STATUS_RUNNING:
                        return int(process.pid)
    raise BenchError(
        "no slot executes a rollout, so none can be killed: expected a busy worker; measure again"
    )


def _others_s(cluster: BenchCluster) -> tuple[float, float, float]:
    """CPU seconds of slots, manager, and daemons."""
    manager, *daemons = (process.child.pid for process in cluster.processes)
    slots_s = daemons_s = 0.0
    for daemon in daemons:
        for process, depth in _tree(daemon):
            if depth >= SLOT_DEPTH:
                slots_s += cpu_s(process)
            else:
                daemons_s += cpu_s(process)
    return slots_s, cpu_s(psutil.Process(manager)), daemons_s


def _tree(root: int) -> Iterator[tuple[psutil.Process, int]]:
    """Yield a process and its descendants with their depth, from one scan of the system's processes."""
    children: dict[int, list[psutil.Process]] = {}
    for process in psutil.process_iter(["ppid"]):
        children.setdefault(process.info["ppid"], []).append(process)
    found = [(psutil.Process(root), 0)]
    while found:
        process, depth = found.pop()
        yield process, depth
        found += [(child, depth + 1) for child in children.get(process.pid, ())]
