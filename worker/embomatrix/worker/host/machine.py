"""Observation of this machine: its owner's activity, its power and the load of other programs. It needs no root."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import psutil

from embomatrix.host.limits import MIB
from embomatrix.rpc.wire.values import HostUse
from embomatrix.worker.host.owner_policy import Observation, Preferences

SESSIONS_ASKED_S: Final = 10.0
"""Interval between two queries of the desktop sessions, which start two processes each."""
SESSIONS_ANSWER_S: Final = 5.0
GRAPHICAL: Final = frozenset({"x11", "wayland", "mir"})
NEVER_S: Final = 1e9
"""Idle time if no user is logged in."""
DEVICES: Final = Path("/dev")


class Probe(Protocol):
    """Observes a machine within some milliseconds, without raising."""

    def observe(self) -> Observation: ...


class HostMachine:
    """This machine. ``ours`` returns the process ids of all worker daemons here, whose load is not that of others."""

    def __init__(self, ours: Callable[[], Iterable[int]], owner: Owner | None = None) -> None:
        self._owner = owner or (Owner() if sys.platform == "linux" else None)
        self._load = OthersLoad(ours)

    def observe(self) -> Observation:
        local = time.localtime()
        memory = psutil.virtual_memory()
        return Observation(
            minute=local.tm_hour * 60 + local.tm_min,
            owner_idle_s=None if self._owner is None else self._owner.idle_s(time.time()),
            on_mains=on_mains(),
            others_load=self._load.share(),
            free_memory=memory.available / memory.total,
        )

    def unsupported(self, preferences: Preferences, seen: Observation) -> list[str]:
        """One sentence for each preference that this machine can't support."""
        sentences = []
        if preferences.idle_s and seen.owner_idle_s is None:
            sentences.append(
                "this system does not show its users' activity: idle_s has no effect, use hours or max_load"
            )
        if preferences.mains_only and seen.on_mains is None:
            sentences.append("no battery was found: mains_only has no effect")
        return sentences


def on_mains() -> bool | None:
    """Return whether the machine is on mains power; None if it has no known battery."""
    ask = getattr(psutil, "sensors_battery", None)
    battery = ask() if ask is not None else None
    return None if battery is None else battery.power_plugged


class Owner:
    """Last activity of a user: typing in a terminal, and what the desktop reports to logind."""

    def __init__(self, devices: Path = DEVICES, sessions: Callable[[], str] | None = None) -> None:
        self._devices = devices
        self._sessions = sessions or ask_sessions
        self._desktop_active_s: float | None = None
        self._queried_s = float("-inf")

    def idle_s(self, now_s: float) -> float:
        """Seconds since the last activity at the wall time ``now_s``; very many if no user is logged in."""
        if now_s - self._queried_s >= SESSIONS_ASKED_S:
            self._queried_s = now_s
            self._desktop_active_s = desktop_active_s(self._sessions(), now_s)
        signs = [terminal_active_s(self._devices), self._desktop_active_s]
        return max(0.0, now_s - max((sign for sign in signs if sign is not None), default=now_s - NEVER_S))


def terminal_active_s(devices: Path = DEVICES) -> float | None:
    """Wall time of the last typing in any terminal, local or remote, from the terminals' access times.

    `w` shows the same as idle time. The kernel rounds it to eight seconds.
    """
    times = []
    for path in (*devices.glob("pts/[0-9]*"), *devices.glob("tty[0-9]*")):
        try:
            times.append(path.stat().st_atime)
        except OSError:
            continue  # closed meanwhile
    return max(times, default=None)


def ask_sessions() -> str:
    """Properties of all sessions as ``loginctl`` prints them; empty without logind."""
    program = shutil.which("loginctl")
    if program is None:
        return ""
    try:
        listed = _answer_of(program, "list-sessions", "--no-legend", "--no-pager")
        names = [line.split()[0] for line in listed.splitlines() if line.split()]
        properties = "Type,Class,State,IdleHint,IdleSinceHint"
        return _answer_of(program, "show-session", f"--property={properties}", *names) if names else ""
    except (OSError, subprocess.SubprocessError):
        return ""


def _answer_of(*command: str) -> str:
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=SESSIONS_ANSWER_S,
        check=True,
        stdin=subprocess.DEVNULL,
    ).stdout


def desktop_active_s(sessions: str, now_s: float) -> float | None:
    """Wall time of the last use of a desktop; None if no user has one.

    A desktop sets a hint when its screen becomes idle. A desktop without a hint counts as in use. Sessions in terminals are
    ignored here, because logind takes half an hour to call them idle.
    """
    times = []
    for block in sessions.strip().split("\n\n"):
        session = dict(line.split("=", 1) for line in block.splitlines() if "=" in line)
        if session.get("Type") not in GRAPHICAL or session.get("Class") != "user":
            continue
        if session.get("State") == "closing":
            continue
        since_us = session.get("IdleSinceHint", "")
        idle = session.get("IdleHint") == "yes" and since_us.isdigit()
        times.append(int(since_us) / 1e6 if idle else now_s)
    return max(times, default=None)


@dataclass(frozen=True, slots=True)
class CpuTimes:
    """CPU seconds since boot: all, busy ones, and busy ones of our processes."""

    total_s: float
    busy_s: float
    ours_s: float

    def others_share_since(self, before: CpuTimes) -> float:
        """Share of all cores that other programs used in between, 0 to 1."""
        total_s = self.total_s - before.total_s
        # The count falls if one of our processes dies together with its parent.
        ours_s = max(0.0, self.ours_s - before.ours_s)
        return min(1.0, max(0.0, self.busy_s - before.busy_s - ours_s) / total_s) if total_s > 0 else 0.0


class HostMeter:
    """Use of this machine by all programs between two queries. A query takes a tenth of a millisecond."""

    def __init__(self) -> None:
        self._before = (0.0, 0.0)
        self.use()

    def use(self) -> HostUse | None:
        """Return the use since the last query; None where the system hides it."""
        try:
            total_s, busy_s = _machine_cpu_s()
            memory = psutil.virtual_memory()
        except (psutil.Error, OSError):
            return None
        (total_before_s, busy_before_s), self._before = self._before, (total_s, busy_s)
        spent_s = total_s - total_before_s
        share = (busy_s - busy_before_s) / spent_s if spent_s > 0 else 0.0
        used_mb = (memory.total - memory.available) // MIB
        return HostUse(min(1.0, max(0.0, share)), used_mb, memory.total // MIB)


def _machine_cpu_s() -> tuple[float, float]:
    """Return the CPU seconds of all cores since boot, and the busy ones among them."""
    whole = psutil.cpu_times()
    # User time includes guest time already.
    total_s = sum(whole) - getattr(whole, "guest", 0.0) - getattr(whole, "guest_nice", 0.0)
    return total_s, total_s - whole.idle - getattr(whole, "iowait", 0.0)


class OthersLoad:
    """CPU load of other programs between two queries."""

    def __init__(self, ours: Callable[[], Iterable[int]]) -> None:
        self._ours = ours
        self._before = self._times()

    def share(self) -> float:
        """Share of all cores since the last query, 0 to 1."""
        now = self._times()
        share = now.others_share_since(self._before)
        self._before = now
        return share

    def _times(self) -> CpuTimes:
        return CpuTimes(*_machine_cpu_s(), sum(map(family_cpu_s, set(self._ours()))))


def family_cpu_s(pid: int) -> float:
    """CPU seconds of a process and its descendants, including those that were collected."""
    try:
        root = psutil.Process(pid)
        family = [root, *root.children(recursive=True)]
    except psutil.Error:
        return 0.0
    seconds = 0.0
    for process in family:
        try:
            times = process.cpu_times()
        except psutil.Error:
            continue
        seconds += times.user + times.system + times.children_user + times.children_system
    return seconds
