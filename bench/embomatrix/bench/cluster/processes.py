"""A manager and workers on loopback, each a process of its own, for as long as a bench lasts."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.host.parent import with_this_process

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

GRACE_S: Final = 10.0
"""How long a process may take to leave before it is killed."""
LOG_LINES: Final = 5
_SERVES: Final = re.compile(r"manager serves at (\S+:\d+),")


@dataclass(frozen=True, slots=True)
class Process:
    """A child and the file that its output goes to."""

    name: str
    child: subprocess.Popen[bytes]
    log: Path

    def check(self) -> None:
        """Raises BenchError with the end of its log when it is gone."""
        status = self.child.poll()
        if status is not None:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_LINES:]
            raise BenchError(
                f"{self.name} ended with status {status}: {' / '.join(lines) or 'it said nothing'}"
            )


@dataclass(frozen=True, slots=True)
class BenchCluster:
    """Where the manager answers, and the processes: the manager's first."""

    address: str
    processes: tuple[Process, ...]

    @property
    def workers(self) -> frozenset[str]:
        return frozenset(process.name for process in self.processes[1:])

    def check(self) -> None:
        """Raises BenchError when one of the processes is gone."""
        for process in self.processes:
            process.check()


@contextlib.contextmanager
def bench_cluster(
    folder: Path,
    *,
    workers: int,
    slots: int,
    deadline_s: float,
    load_delay_s: float = 0.0,
    state: str = "",
) -> Iterator[BenchCluster]:
    """Start the processes, with state and logs below ``folder``; end them at the end, whatever happens.

    ``state`` is the URL of the manager's store, by default the embedded one.
    The workers may still be connecting. With ``load_delay_s`` they load every scene so many seconds later.
    ``deadline_s`` is on the monotonic clock: raises BenchError when the manager does not serve by then, or ends.
    """
    with contextlib.ExitStack() as started:
        manager = started.enter_context(
            running_process(
                folder,
                "manager",
                *("embomatrix.cli", "manager", "serve", "--port=0", "--http-port=0"),
                *(f"--state={state or f'sqlite:{folder}/state.sqlite'}", f"--data-dir={folder / 'manager'}"),
            )
        )
        address = _address_of(manager, deadline_s)
        daemons = tuple(
            started.enter_context(
                running_process(folder, name, *_worker_command(folder, address, name, slots, load_delay_s))
            )
            for name in (f"worker-{number}" for number in range(1, workers + 1))
        )
        yield BenchCluster(address, (manager, *daemons))


def _worker_command(
    folder: Path, address: str, name: str, slots: int, load_delay_s: float
) -> tuple[str, ...]:
    cache = folder / "cache" / name
    if load_delay_s:
        slow = "embomatrix.bench.cluster.slow_worker"
        return (slow, str(load_delay_s), address, name, str(slots), str(cache))
    worker = ("embomatrix.cli", "worker", "run", f"--manager={address}", f"--name={name}", f"--slots={slots}")
    # As polite as the bench itself: manager, workers and trainer share the cores alike.
    return (*worker, f"--cache-dir={cache}", "--nice=0")


def running_process(folder: Path, name: str, *arguments: str) -> contextlib.AbstractContextManager[Process]:
    """A module of this interpreter with its arguments, in the background."""
    return running_program(folder, name, sys.executable, "-m", *arguments)


@contextlib.contextmanager
def running_program(folder: Path, name: str, *command: str) -> Iterator[Process]:
    """The program, in the background, with a log below ``folder``."""
    log = folder / f"{name}.log"
    with log.open("wb") as file:
        child = subprocess.Popen(
            command,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            preexec_fn=with_this_process(),
        )
    try:
        yield Process(name, child, log)
    finally:
        child.terminate()
        try:
            child.wait(timeout=GRACE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _address_of(manager: Process, deadline_s: float) -> str:
    """HOST:PORT that the manager says it serves at."""
    while time.monotonic() < deadline_s:
        found = _SERVES.search(manager.log.read_text(encoding="utf-8", errors="replace"))
        if found:
            return found[1]
        manager.check()
        time.sleep(0.05)
    raise BenchError(
        "the manager did not serve in time: is the machine overloaded? Allow more with --limit-s"
    )
