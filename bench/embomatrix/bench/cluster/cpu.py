"""Processor time of a bench's cluster: in the slots, and outside them."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.bench.report.figures import BenchError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.bench.cluster.processes import BenchCluster

TRIES: Final = 100
"""Looks for a slot that executes: between two rollouts none does."""
SLOT_DEPTH: Final = 3
"""A slot is forked by its scene, the scene by the root, and the root is a child of the daemon."""


@dataclass(frozen=True, slots=True)
class CpuUse:
    """Seconds of processor time."""

    slots_s: float
    manager_s: float
    daemons_s: float
    """Of the daemons with their roots and scenes: all of a worker but its slots."""
    trainer_s: float
    """Of this process, which submits and takes the results."""

    @property
    def overhead(self) -> float:
        """Share of all processor time that was spent outside the slots."""
        outside_s = self.manager_s + self.daemons_s + self.trainer_s
        return outside_s / (outside_s + self.slots_s)


class CpuWatch:
    """Processor time from its making on. What looking costs this process is left out: it takes as much as hundreds of results.

    Slots that have ended are not counted: none ends while undisturbed work goes on.
    """

    def __init__(self, cluster: BenchCluster) -> None:
        self._cluster = cluster
        self._before = _others_s(cluster)
        self._own_s = time.process_time()

    def used(self) -> CpuUse:
        """Until now."""
        own_s = time.process_time() - self._own_s
        others_s = zip(_others_s(self._cluster), self._before, strict=True)
        slots_s, manager_s, daemons_s = (after_s - before_s for after_s, before_s in others_s)
        return CpuUse(slots_s, manager_s, daemons_s, own_s)


def descendants_cpu_s() -> float:
    """Processor time of all that descend from this process and live, in seconds."""
    return sum(cpu_s(process) for process, depth in _tree(os.getpid()) if depth)


def _others_s(cluster: BenchCluster) -> tuple[float, float, float]:
    """Seconds of slots, manager, and daemons."""
    manager, *daemons = (process.child.pid for process in cluster.processes)
    slots_s = daemons_s = 0.0
    for daemon in daemons:
        for process, depth in _tree(daemon):
            if depth >= SLOT_DEPTH:
                slots_s += cpu_s(process)
            else:
                daemons_s += cpu_s(process)
    return slots_s, cpu_s(psutil.Process(manager)), daemons_s


def running_slot(cluster: BenchCluster) -> int:
    """Process id of a slot that executes now. Raises BenchError when there is none."""
    for _ in range(TRIES):
        for worker in cluster.processes[1:]:
            for process, depth in _tree(worker.child.pid):
                with contextlib.suppress(psutil.Error):
                    if depth >= SLOT_DEPTH and process.status() == psutil.STATUS_RUNNING:
                        return int(process.pid)
    raise BenchError("no slot is at work that could be killed: expected one that executes")


def _tree(root: int) -> Iterator[tuple[psutil.Process, int]]:
    """A process and all that descend from it, each with how far: by one look at the system's processes."""
    children: dict[int, list[psutil.Process]] = {}
    for process in psutil.process_iter(["ppid"]):
        children.setdefault(process.info["ppid"], []).append(process)
    found = [(psutil.Process(root), 0)]
    while found:
        process, depth = found.pop()
        yield process, depth
        found += [(child, depth + 1) for child in children.get(process.pid, ())]


def cpu_s(process: psutil.Process) -> float:
    """Its processor time, in seconds; 0 of one that has ended."""
    with contextlib.suppress(psutil.Error):
        times = process.cpu_times()
        return float(times.user + times.system)
    return 0.0
