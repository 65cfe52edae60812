"""How long a spare PC takes to join: from the one command to its place among the workers."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.processes import running_process
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.bench.cluster.processes import Process

JOIN_S: Final = 30.0
LIMIT_S: Final = 120.0
_SERVES: Final = re.compile(r"manager serves at \S+:(\d+),")
_CLI: Final = "embomatrix.cli"


def joining(on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Seconds from `embomatrix worker run --join` to the worker's registration, by TLS, with a machine's own credential."""
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        folder = Path(name)
        data = f"--data-dir={folder / 'manager'}"
        on_step("certificates and a manager")
        _told("manager", "init", data, "--san=localhost")
        serve = (_CLI, "manager", "serve", "--port=0", "--http-port=0", "--state=memory:", data)
        with running_process(folder, "manager", *serve) as manager:
            port = _SERVES.search(wait_for(manager, "status page"))
            if port is None:
                raise BenchError(f"the manager did not tell its port: see what it said, {manager.log}")
            address, access = f"localhost:{port[1]}", folder / "manager" / "access"
            show = (
                f"--manager={address}",
                f"--token=@{access / 'tokens' / 'admin'}",
                f"--ca={access / 'ca.pem'}",
            )
            invitation = _told("manager", "token", "issue", "--role=join", *show).strip()
            on_step("a worker joins")
            started_s = time.monotonic()
            join = (_CLI, "worker", "run", "--join", invitation, f"--state-dir={folder / 'state'}")
            with running_process(
                folder, "worker", *join, f"--cache-dir={folder / 'cache'}", "--nice=0"
            ) as worker:
                wait_for(worker, "registered with the manager")
                taken_s = time.monotonic() - started_s
    return (Figure("join_s", taken_s, "s", Better.LOWER, 1, JOIN_S),)


def _told(*arguments: str) -> str:
    """What a command prints. Raises BenchError."""
    done = subprocess.run(
        (sys.executable, "-m", _CLI, *arguments), capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    if done.returncode:
        raise BenchError(f"embomatrix {' '.join(arguments[:2])}: {done.stderr.strip()}")
    return done.stdout


def wait_for(process: Process, words: str) -> str:
    """All that the process has said, once it said this."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        text = process.log.read_text(encoding="utf-8", errors="replace")
        if words in text:
            return text
        process.check()
        time.sleep(0.05)
    raise BenchError(f"{process.name} did not say {words!r} in {LIMIT_S:.0f} s: is the machine overloaded?")
