"""Supervisor of child processes: restarts them when they die, and ends them together.

A child that exits with ``MENDABLE`` is not restarted: it would fail in the same way. On Linux the children die with this
process, even if it is killed.
"""

import contextlib
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from embomatrix.host.failure import MENDABLE
from embomatrix.host.parent import with_this_process

logger = logging.getLogger(__name__)

RESTART_DELAY_S: Final = 0.5
MAX_RESTARTS_IN_A_ROW: Final = 5
"""Number of consecutive short lives after which a child is given up."""
SHORT_LIFE_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class ChildSpec:
    """A process to supervise. ``name`` also names its log file."""

    name: str
    arguments: tuple[str, ...]
    environment: Mapping[str, str]


@dataclass(slots=True)
class _Child:
    spec: ChildSpec
    process: subprocess.Popen[bytes]
    started_s: float
    restarts: int = 0
    short_lives: int = 0
    given_up: bool = field(default=False)


def embomatrix_command(*arguments: str) -> tuple[str, ...]:
    """Return the command line of an `embomatrix` command under this interpreter."""
    return (sys.executable, "-m", "embomatrix.cli", *arguments)


class Supervisor:
    """Context manager: starts the children on entry, restarts them while open, and ends them on exit."""

    def __init__(self, specs: tuple[ChildSpec, ...], log_folder: Path, *, grace_s: float = 10.0) -> None:
        self._specs = specs
        self._log_folder = log_folder
        self._grace_s = grace_s
        self._children: dict[str, _Child] = {}
        self._closing = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="supervisor", daemon=True)
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self._log_folder.mkdir(parents=True, exist_ok=True)
        for spec in self._specs:
            self._children[spec.name] = _Child(spec, self._start(spec), time.monotonic())
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._watcher.join()
        for child in self._children.values():
            with contextlib.suppress(ProcessLookupError):
                child.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + self._grace_s
        for child in self._children.values():
            try:
                child.process.wait(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()

    def pid(self, name: str) -> int:
        """Return the process id of the running child."""
        with self._lock:
            return self._children[name].process.pid

    def restarts(self, name: str) -> int:
        """Return the number of restarts of the child."""
        with self._lock:
            return self._children[name].restarts

    def log_path(self, name: str) -> Path:
        return self._log_folder / f"{name}.log"

    def failed(self) -> tuple[str, ...]:
        """Return the names of children that were given up."""
        with self._lock:
            return tuple(name for name, child in self._children.items() if child.given_up)

    def last_words(self, name: str) -> str:
        """Return the last line of the child's log; empty if there is none."""
        lines = self.log_path(name).read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def _start(self, spec: ChildSpec) -> subprocess.Popen[bytes]:
        with self.log_path(spec.name).open("ab") as log:
            return subprocess.Popen(
                spec.arguments,
                env=dict(spec.environment),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # Ctrl-C reaches only the foreground command, which ends the cluster afterwards.
                start_new_session=True,
                preexec_fn=with_this_process(signal.SIGTERM),
            )

    def _watch(self) -> None:
        while not self._closing.wait(0.2):
            with self._lock:
                for child in self._children.values():
                    if child.process.poll() is not None and not child.given_up:
                        self._revive(child)

    def _revive(self, child: _Child) -> None:
        lived_s = time.monotonic() - child.started_s
        child.short_lives = child.short_lives + 1 if lived_s < SHORT_LIFE_S else 0
        if child.process.returncode == MENDABLE or child.short_lives > MAX_RESTARTS_IN_A_ROW:
            child.given_up = True
            logger.error("%s ended with status %s and is given up", child.spec.name, child.process.returncode)
            return
        logger.warning("%s ended with status %s: restarting it", child.spec.name, child.process.returncode)
        time.sleep(RESTART_DELAY_S)
        child.process = self._start(child.spec)
        child.started_s = time.monotonic()
        child.restarts += 1
