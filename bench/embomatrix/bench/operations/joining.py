"""Time for a spare PC to join: from the join command to the worker's registration."""

import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from embomatrix.bench.cluster.processes import SERVES, output_of, running_manager, running_process
from embomatrix.cli.supervisor import embomatrix_command
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
        output_of(*embomatrix_command("manager", "init", data, "--san=localhost"), limit_s=LIMIT_S)
        deadline_s = time.monotonic() + LIMIT_S
        with running_manager(folder, "--state=memory:", data) as manager:
            port = manager.wait_for(SERVES, deadline_s)[1].rpartition(":")[2]
            issue = embomatrix_command("manager", "token", "issue", "--role=join")
            admin = (f"--token=@{access / 'tokens' / 'admin'}", f"--ca={access / 'ca.pem'}")
            invitation = output_of(*issue, f"--manager=localhost:{port}", *admin, limit_s=LIMIT_S).strip()
            on_step("a worker joins")
            started_s = time.monotonic()
            join = ("worker", "run", "--join", invitation, "--nice=0", f"--state-dir={folder / 'state'}")
            cache = f"--cache-dir={folder / 'cache'}"
            with running_process(folder, "worker", "embomatrix.cli", *join, cache) as worker:
                worker.wait_for(_REGISTERED, deadline_s)
                taken_s = time.monotonic() - started_s
    return (Figure("join_s", taken_s, "s", Better.LOWER, 1, JOIN_GOAL_S),)
