"""`embomatrix worker ray`: worker daemons as actors on an existing Ray cluster.

Ray places them by cores and memory and restarts them if a node is lost. The manager handles leases, scenes and results as with
any worker.
"""

import importlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console

from embomatrix.host.parent import with_this_process
from embomatrix.worker.commands.options import fail

DRAIN_S: Final = 90.0
"""Longer than the time that running rollouts have to end."""
FINAL: Final = frozenset({0, 2})
"""Exit statuses without a restart: the daemon left, or a user must fix an error."""


class PlacedWorker:
    """Actor with one daemon as its child process, which dies with it."""

    def __init__(self, name: str, arguments: list[str]) -> None:
        folder = Path(tempfile.gettempdir()) / f"embomatrix-{os.getuid()}" / name
        command = [sys.executable, "-m", "embomatrix.cli", "worker", "run", "--name", name]
        folders = [f"--cache-dir={folder / 'cache'}", f"--state-dir={folder / 'state'}"]
        self._child = subprocess.Popen([*command, *folders, *arguments], preexec_fn=with_this_process())

    def ended(self) -> int:
        """Wait for the daemon and return its exit status. A status that is not final ends the actor, and Ray restarts it."""
        status = self._child.wait()
        if status not in FINAL:
            os._exit(1)
        return status

    def drain(self) -> None:
        """Drain the daemon: running rollouts end and are delivered."""
        self._child.terminate()
        try:
            self._child.wait(DRAIN_S)
        except subprocess.TimeoutExpired:
            self._child.kill()


def ray_workers(
    context: typer.Context,
    workers: Annotated[int, typer.Option(min=1, help="Number of daemons.")] = 1,
    cpus: Annotated[int, typer.Option(min=1, help="Cores and concurrent rollouts of each.")] = 1,
    memory_mb: Annotated[int, typer.Option(min=256, help="Memory of each, in MB.")] = 4096,
    address: Annotated[
        str, typer.Option(help="Address of the Ray cluster; `local` starts one on this machine.")
    ] = "auto",
    prefix: Annotated[str, typer.Option(help="Prefix of the workers' names: PREFIX-0, PREFIX-1 …")] = "ray",
) -> None:
    """Run workers on a Ray cluster until interrupted; options of `worker run`, such as --manager, follow `--`."""
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError:
        fail("Ray is not installed here: `pip install 'embomatrix[ray]'`, on every node of its cluster too")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        ray.init(address=address, log_to_driver=True, include_dashboard=False if address == "local" else None)
    except ConnectionError as error:
        fail(f"no Ray cluster answers at {address!r} ({error}): start one with `ray start --head`")
    # Two concurrent methods: one waits for the end, the other requests it.
    actor = ray.remote(
        num_cpus=cpus,
        memory=memory_mb * 1_000_000,
        max_restarts=-1,
        max_task_retries=-1,
        max_concurrency=2,
    )(PlacedWorker)
    limits = [f"--slots={cpus}", f"--memory-mb={memory_mb}", "--nice=0", *context.args]
    placed = {f"{prefix}-{number}": actor.remote(f"{prefix}-{number}", limits) for number in range(workers)}
    try:
        _watch(ray, placed, Console(soft_wrap=True))
    except KeyboardInterrupt:
        ray.get([each.drain.remote() for each in placed.values()], timeout=DRAIN_S + 10)
    finally:
        ray.shutdown()


def _watch(ray: Any, placed: dict[str, Any], console: Console) -> None:
    """Report every daemon that has ended permanently; return when all have."""
    waiting = {each.ended.remote(): name for name, each in placed.items()}
    console.print(f"{len(placed)} workers run on Ray; Ctrl-C drains them", highlight=False)
    while waiting:
        for over in ray.wait(list(waiting), timeout=1.0)[0]:
            console.print(f"{waiting.pop(over)} ended with status {ray.get(over)}", highlight=False)
