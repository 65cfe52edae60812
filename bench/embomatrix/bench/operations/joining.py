"""Time for a spare PC to join: from the join command to the worker's registration."""

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from embomatrix.bench.cluster.processes import SERVES, running_manager, running_process
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure

JOIN_GOAL_S: Final = 30.0
LIMIT_S: Final = 120.0
_REGISTERED: Final = re.compile("registered with the manager")


def measure_joining(on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Join by TLS with a credential of the machine, as `embomatrix worker run --join` does."""
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        folder = Path(name)
        data, access = f"--data-dir={folder / 'manager'}", folder / "manager" / "access"
        on_step("certificates and a manager")
        _output("manager", "init", data, "--san=localhost")
        deadline_s = time.monotonic() + LIMIT_S
        with running_manager(folder, "--state=memory:", data) as manager:
            port = manager.wait_for(SERVES, deadline_s)[1].rpartition(":")[2]
            invitation = _output(
                *("manager", "token", "issue", "--role=join", f"--manager=localhost:{port}"),
                *(f"--token=@{access / 'tokens' / 'admin'}", f"--ca={access / 'ca.pem'}"),
            ).strip()
            on_step("a worker joins")
            started_s = time.monotonic()
            join = ("worker", "run", "--join", invitation, "--nice=0", f"--state-dir={folder / 'state'}")
            cache = f"--cache-dir={folder / 'cache'}"
            with running_process(folder, "worker", "embomatrix.cli", *join, cache) as worker:
                worker.wait_for(_REGISTERED, deadline_s)
                taken_s = time.monotonic() - started_s
    return (Figure("join_s", taken_s, "s", Better.LOWER, 1, JOIN_GOAL_S),)


def _output(*arguments: str) -> str:
    command = (sys.executable, "-m", "embomatrix.cli", *arguments)
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode:
        raise BenchError(f"embomatrix {' '.join(arguments[:2])} failed: {done.stderr.strip()}")
    return done.stdout
