"""Workers' machines in bounded memory: use of CPU and memory over time, and the latest lines of each worker's log."""

import math
from array import array
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from embomatrix.host.printable import printable
from embomatrix.rpc.logs import without_secrets
from embomatrix.rpc.wire.values import HostUse

STEP_S: Final = 10.0
"""Heartbeats within this time share one point, their mean."""
POINTS: Final = 180
"""Points of one machine at most: half an hour. Older ones are dropped, also after a pause."""
GAP_S: Final = 6 * STEP_S
"""Time without a heartbeat from which the curve has a gap."""
LINES: Final = 50
"""Log lines of one worker at most."""
HOSTS_KEPT: Final = 20_000
ALL_LINES: Final = 100_000
"""Machines, and log lines of all together, at most; those of the longest silent workers are dropped first."""


@dataclass(frozen=True, slots=True)
class HostCurve:
    """Use of a machine over time, oldest first. ``at_s`` is the begin of each step, in seconds since the epoch.

    A step of None stands for a time in which the worker was silent.
    """

    at_s: list[float]
    cpu_share: list[float | None]
    memory_used_mb: list[int | None]
    memory_mb: int
    """Memory of the machine; 0 if the worker does not report it."""


@dataclass(slots=True)
class _Host:
    """``beats`` counts the heartbeats of the last point."""

    boot_id: str = ""
    session_id: str = ""
    use: HostUse | None = None
    beats: int = 0
    at_s: "array[float]" = field(default_factory=lambda: array("d"))
    cpu_share: "array[float]" = field(default_factory=lambda: array("f"))
    memory_mb: "array[float]" = field(default_factory=lambda: array("f"))
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=LINES))


class HostBook:
    """Machines by worker, at most ``hosts`` with ``lines`` in all. The manager's own secrets are masked in log lines too."""

    def __init__(self, *, hosts: int = HOSTS_KEPT, lines: int = ALL_LINES) -> None:
        self._most_hosts = hosts
        self._most_lines = lines
        self._hosts: OrderedDict[str, _Host] = OrderedDict()
        """The longest silent worker first."""
        self._lines = 0

    def note(
        self,
        worker_id: str,
        boot_id: str,
        session_id: str,
        use: HostUse | None,
        lines: Sequence[str],
        *,
        at_s: float,
    ) -> None:
        """Add a heartbeat. A worker repeats its lines in a new session; lines of an earlier process stay."""
        host = self._hosts.setdefault(worker_id, _Host())
        self._hosts.move_to_end(worker_id)
        self._lines -= len(host.lines)
        if session_id != host.session_id:
            if boot_id == host.boot_id:
                host.lines.clear()
            host.boot_id, host.session_id = boot_id, session_id
        host.lines.extend(printable(without_secrets(line)) for line in lines)
        self._lines += len(host.lines)
        host.use = use
        if use is not None:
            _add(host, use, at_s)
        self._forget()

    def use_of(self, worker_id: str) -> HostUse | None:
        """Return the latest use of the worker's machine; None if it does not report it."""
        host = self._hosts.get(worker_id)
        return host.use if host is not None else None

    def curve_of(self, worker_id: str) -> HostCurve:
        """Return the last half hour of the worker's machine."""
        host = self._hosts.get(worker_id) or _Host()
        return HostCurve(
            list(host.at_s),
            [None if math.isnan(share) else round(share, 4) for share in host.cpu_share],
            [None if math.isnan(used) else round(used) for used in host.memory_mb],
            host.use.memory_mb if host.use is not None else 0,
        )

    def lines_of(self, worker_id: str) -> list[str]:
        """Return the latest lines of the worker's log, oldest first."""
        host = self._hosts.get(worker_id)
        return list(host.lines) if host is not None else []

    def _forget(self) -> None:
        while len(self._hosts) > self._most_hosts:
            _, host = self._hosts.popitem(last=False)
            self._lines -= len(host.lines)
        if self._lines > self._most_lines:
            # The next heartbeats leave room for many lines before hosts are searched again.
            for host in self._hosts.values():
                self._lines -= len(host.lines)
                host.lines.clear()
                if self._lines <= self._most_lines * 9 // 10:
                    return


def _add(host: _Host, use: HostUse, at_s: float) -> None:
    if host.at_s and 0.0 <= at_s - host.at_s[-1] < STEP_S:
        host.beats += 1
        host.cpu_share[-1] += (use.cpu_share - host.cpu_share[-1]) / host.beats
        host.memory_mb[-1] += (use.memory_used_mb - host.memory_mb[-1]) / host.beats
        return
    host.beats = 1
    if host.at_s and at_s - host.at_s[-1] > GAP_S:
        _append(host, host.at_s[-1] + STEP_S, math.nan, math.nan)
    _append(host, at_s, use.cpu_share, use.memory_used_mb)
    old = next(place for place, begin_s in enumerate(host.at_s) if at_s - begin_s < POINTS * STEP_S)
    old = max(old, len(host.at_s) - POINTS)
    for column in (host.at_s, host.cpu_share, host.memory_mb):
        del column[:old]


def _append(host: _Host, at_s: float, cpu_share: float, memory_mb: float) -> None:
    host.at_s.append(at_s)
    host.cpu_share.append(cpu_share)
    host.memory_mb.append(memory_mb)
