"""Processor time of a bench's cluster: in the slots, and outside them."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.worker.bench_figures import BenchError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.worker.bench_processes import BenchCluster

TRIES: Final = 100
"""Looks for a slot that executes: between two rollouts none does."""
SLOT_DEPTH: Final = 3
"""A slot is forked by its scene, the scene by the root, and the root is a child of the daemon."""


@dataclass(frozen=True, slots=True)
class CpuUse:
    """Seconds of processor time since the processes began."""

    slots_s: float
    manager_s: float
    daemons_s: float
    """Of the daemons with their roots and scenes: all of a worker but its slots."""
    trainer_s: float
    """Of this process, which submits and takes the results."""

    def since(self, before: CpuUse) -> CpuUse:
        """What was used between two readings."""
        return CpuUse(
            self.slots_s - before.slots_s,
            self.manager_s - before.manager_s,
            self.daemons_s - before.daemons_s,
            self.trainer_s - before.trainer_s,
        )

    @property
    def overhead(self) -> float:
        """Share of all processor time that was spent outside the slots."""
        outside_s = self.manager_s + self.daemons_s + self.trainer_s
        return outside_s / (outside_s + self.slots_s)


def cpu_use(cluster: BenchCluster) -> CpuUse:
    """Read it now. Slots that have ended are not counted: none ends while undisturbed work goes on."""
    manager, *daemons = (psutil.Process(process.child.pid) for process in cluster.processes)
    slots_s = daemons_s = 0.0
    for daemon in daemons:
        for process, depth in _tree(daemon, 0):
            with contextlib.suppress(psutil.Error):
                if depth >= SLOT_DEPTH:
                    slots_s += _seconds(process)
                else:
                    daemons_s += _seconds(process)
    return CpuUse(slots_s, _seconds(manager), daemons_s, _seconds(psutil.Process()))


def family_cpu_s() -> float:
    """Processor time of this process and of all that descend from it and live, in seconds."""
    used_s = 0.0
    for process, _ in _tree(psutil.Process(), 0):
        with contextlib.suppress(psutil.Error):
            used_s += _seconds(process)
    return used_s


def running_slot(cluster: BenchCluster) -> int:
    """Process id of a slot that executes now. Raises BenchError when there is none."""
    for _ in range(TRIES):
        for worker in cluster.processes[1:]:
            for process, depth in _tree(psutil.Process(worker.child.pid), 0):
                with contextlib.suppress(psutil.Error):
                    if depth >= SLOT_DEPTH and process.status() == psutil.STATUS_RUNNING:
                        return int(process.pid)
    raise BenchError("no slot is at work that could be killed: expected one that executes")


def _tree(process: psutil.Process, depth: int) -> Iterator[tuple[psutil.Process, int]]:
    yield process, depth
    with contextlib.suppress(psutil.Error):
        for child in process.children():
            yield from _tree(child, depth + 1)


def _seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)
