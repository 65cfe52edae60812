"""Status file of a daemon, beside its credentials. `embomatrix worker status` reads it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import msgspec
import psutil

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.worker.link.membership import Membership
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

logger = logging.getLogger(__name__)

STATUS_S: Final = 1.0
"""Interval between two updates."""
FOLDER: Final = "running"
"""Subfolder of the credentials' folder."""
CLOCK_STEP_S: Final = 60.0
"""A process that began this much later than the file says is another one with the same process id."""


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """Status of one daemon. Times are wall clock; ``connected_since_s`` is 0 without a connection."""

    name: str
    pid: int
    started_s: float
    manager: str = ""
    connected_since_s: float = 0.0
    paused: str = ""
    draining: bool = False
    slots: int = 0
    running: int = 0
    waiting: int = 0
    completed: int = 0
    failed: int = 0
    unacknowledged: int = 0
    scenes: int = 0
    memory_used_mb: float = 0.0
    memory_mb: float = 0.0
    cache_used_mb: float = 0.0
    cache_mb: float = 0.0


class StatusFile:
    """Status file of one daemon. Errors of the disk are logged and otherwise ignored."""

    def __init__(self, state_dir: Path, name: str) -> None:
        self._path = state_dir.expanduser() / FOLDER / f"{name}.json"
        self._last: WorkerStatus | None = None

    def write(self, status: WorkerStatus) -> None:
        """Write the status if it has changed."""
        if status != self._last:
            with self._errors_logged():
                self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                write_whole(self._path, json.dumps(asdict(status)).encode("utf-8"))
                self._last = status

    async def update(self, current: Callable[[], Awaitable[WorkerStatus]]) -> None:
        """Write the current status until cancelled; then remove the file."""
        try:
            while True:
                self.write(await current())
                await asyncio.sleep(STATUS_S)
        finally:
            self.remove()

    def remove(self) -> None:
        """Remove the file after the daemon has left."""
        with self._errors_logged():
            self._path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _errors_logged(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            logger.debug("status file not updated path=%s: %s", self._path, error)


def running_daemons(state_dir: Path) -> list[WorkerStatus]:
    """Running daemons of this folder by name; files of killed daemons are ignored."""
    found = []
    for path in sorted((state_dir.expanduser() / FOLDER).glob("*.json")):
        try:
            status = msgspec.convert(parse_json(path.read_bytes()), WorkerStatus)
        except (OSError, ValueError):
            continue  # being removed, or of another version
        if _runs(status):
            found.append(status)
    return found


def daemon_pids(state_dir: Path) -> set[int]:
    """Process ids of all daemons of this folder, and of this process."""
    return {os.getpid(), *(status.pid for status in running_daemons(state_dir))}


def refuse_second_daemon(state_dir: Path, membership: Membership, *, remedy: str) -> None:
    """Raise InvalidRequestError if another daemon of this folder has the name at the same manager.

    Each of the two would end the other's session. ``remedy`` says what to do instead of stopping the first one.
    """
    managers = membership.manager.split(",")
    for status in running_daemons(state_dir):
        if status.name == membership.name and status.manager in managers and status.pid != os.getpid():
            raise InvalidRequestError(
                f"worker {status.name!r} runs on this machine already (process {status.pid}), and one worker uses all "
                f"slots: stop that one, or {remedy}"
            )


def _runs(status: WorkerStatus) -> bool:
    try:
        began_s: float = psutil.Process(status.pid).create_time()
    except (psutil.Error, ValueError, OverflowError):
        return False
    return began_s < status.started_s + CLOCK_STEP_S
