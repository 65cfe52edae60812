"""Local cluster: a supervised manager and workers on loopback, and other commands run in the foreground beside it."""

import contextlib
import os
import random
import signal
import socket
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.cli.supervisor import ChildSpec, Supervisor, embomatrix_command
from embomatrix.host.failure import INTERRUPTED, fail
from embomatrix.host.parent import with_this_process

MEMBERSHIP: Final = frozenset({"EMBOMATRIX_MANAGER", "EMBOMATRIX_TOKEN", "EMBOMATRIX_CA", "EMBOMATRIX_JOIN"})
SERVER_PORTS: Final = range(20_000, 32_768)
_RESERVED: Final[list[socket.socket]] = []
"""UDP sockets with the numbers of the ports that ``free_port`` returned. Nothing else here uses UDP."""

MEMORY_SHARE: Final = 0.1
"""Share of the free memory for the scenes of all workers together. The trainer and a person's other programs need the rest, and
scenes that stay beyond the look-ahead are of no use before the next epoch. With 0.8, steps 20 to 40 of a demo took a quarter
longer."""

STOP_S: Final = 60.0
"""Time for an interrupted command to save its state."""


@dataclass(frozen=True, slots=True)
class LocalCluster:
    """A described local cluster; its supervisor starts it."""

    address: str
    dashboard: str
    supervisor: Supervisor
    workers: tuple[str, ...]


def local_cluster(folder: Path, *, workers: int, slots: int, dataset: Path | None = None) -> LocalCluster:
    """Describe a cluster on free loopback ports, with state, bundles and logs below ``folder``.

    Its dashboard shows the tasks of ``dataset``.
    """
    port, http_port = free_port(), free_port()
    address = f"127.0.0.1:{port}"
    # BLAS and OpenMP pools of the daemons would compete with the trainer for cores.
    environment = {**without_membership(os.environ), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    serve = [f"--state=sqlite:{folder / 'manager.sqlite'}", f"--data-dir={folder / 'bundles'}"]
    if dataset is not None:
        serve.append(f"--dataset={dataset}")
    command = embomatrix_command("manager", "serve", f"--port={port}", f"--http-port={http_port}", *serve)
    manager = ChildSpec("manager", command, environment)
    names = tuple(f"worker-{number}" for number in range(1, workers + 1))
    each = [f"--slots={slots}", f"--memory-share={MEMORY_SHARE / workers:.4f}"]
    daemons = tuple(ChildSpec(name, _worker(name, address, folder, each), environment) for name in names)
    supervisor = Supervisor((manager, *daemons), folder / "logs")
    return LocalCluster(address, f"http://127.0.0.1:{http_port}", supervisor, names)


def _worker(name: str, address: str, folder: Path, options: Sequence[str]) -> tuple[str, ...]:
    own = [f"--name={name}", f"--cache-dir={folder / 'cache' / name}"]
    return embomatrix_command("worker", "run", f"--manager={address}", *own, *options)


def without_membership(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without the settings of another cluster: this one has no TLS and no tokens."""
    return {name: value for name, value in environment.items() if name not in MEMBERSHIP}


def free_port() -> int:
    """Return a TCP port that is free on the loopback interface, and that no other call returns while this process lives.

    It lies below the range from which Linux takes the ports of outgoing connections, so that none of them occupies it
    before its server does.
    """
    while True:
        port = random.SystemRandom().choice(SERVER_PORTS)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            _reserve(port)
            return port


def _reserve(port: int) -> None:
    """Keep other processes from choosing this port before its server has it. Raises OSError if one has chosen it."""
    reserved = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        reserved.bind(("127.0.0.1", port))
    except OSError:
        reserved.close()
        raise
    _RESERVED.append(reserved)


def run_command(command: str, problem: Callable[[], str], *arguments: str) -> None:
    """Run one `embomatrix` command on behalf of ``command``, and exit with its status if it fails.

    A ``problem`` stops it. Ctrl-C is passed on to it once, so that it can save its state.
    """
    with subprocess.Popen(
        embomatrix_command(*arguments),
        start_new_session=True,
        preexec_fn=with_this_process(signal.SIGTERM),
        env=without_membership(os.environ),
    ) as child:
        try:
            while (status := _status_of(child)) is None:
                if sentence := problem():
                    child.send_signal(signal.SIGTERM)
                    fail(command, sentence)
        except KeyboardInterrupt:
            child.send_signal(signal.SIGINT)
            _end(child)
            raise SystemExit(INTERRUPTED) from None
    if status < 0:
        fail(command, _ended_by(-status, arguments[0]))
    if status:
        raise SystemExit(status)


def _ended_by(number: int, command: str) -> str:
    reason = ", as the system does when memory runs out" if number == signal.SIGKILL else ""
    return (
        f"`embomatrix {command}` was ended from outside by signal {number} ({signal.strsignal(number)}){reason}: "
        "what it had saved is kept, give the same command again"
    )


def cluster_problem(cluster: LocalCluster) -> str:
    """Return why the cluster cannot work: manager or all workers were given up. Empty while it can."""
    failed = cluster.supervisor.failed()
    if "manager" not in failed and not set(cluster.workers) <= set(failed):
        return ""
    name = "manager" if "manager" in failed else failed[0]
    log = cluster.supervisor.log_path(name)
    return f"the cluster can't work, {name} ended with: {cluster.supervisor.last_words(name)} (log: {log})"


def no_problem() -> str:
    """Return no problem, for commands that use no local cluster."""
    return ""


def _status_of(child: subprocess.Popen[bytes]) -> int | None:
    try:
        return child.wait(timeout=0.5)
    except subprocess.TimeoutExpired:
        return None


def _end(child: subprocess.Popen[bytes]) -> None:
    try:
        child.wait(timeout=STOP_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        child.kill()
