"""A cluster on this machine: one manager and a few worker daemons on loopback, supervised."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.cli.supervisor import ChildSpec, Supervisor, embomatrix_command

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

MEMBERSHIP: Final = frozenset({"EMBOMATRIX_MANAGER", "EMBOMATRIX_TOKEN", "EMBOMATRIX_CA", "EMBOMATRIX_JOIN"})


@dataclass(frozen=True, slots=True)
class LocalCluster:
    """Where the manager answers, and the processes behind it."""

    address: str
    dashboard: str
    supervisor: Supervisor
    workers: tuple[str, ...]


def local_cluster(folder: Path, *, workers: int, slots: int, dataset: Path | None = None) -> LocalCluster:
    """Describe a cluster that keeps state, bundles and logs below ``folder``; its supervisor starts it on entry.

    Its dashboard shows the tasks of ``dataset``, if there is one.
    The ports are free ones of the loopback interface, so that several clusters live side by side.
    """
    port, http_port = free_port(), free_port()
    address = f"127.0.0.1:{port}"
    # One thread per process: BLAS and OpenMP pools of idle daemons would only take the trainer's cores.
    environment = {**without_membership(os.environ), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    serve = [f"--state=sqlite:{folder / 'manager.sqlite'}", f"--data-dir={folder / 'bundles'}"]
    if dataset is not None:
        serve.append(f"--dataset={dataset}")
    command = embomatrix_command("manager", "serve", f"--port={port}", f"--http-port={http_port}", *serve)
    manager = ChildSpec("manager", command, environment)
    names = tuple(f"worker-{number}" for number in range(1, workers + 1))
    daemons = tuple(ChildSpec(name, _worker(name, address, slots, folder), environment) for name in names)
    supervisor = Supervisor((manager, *daemons), folder / "logs")
    return LocalCluster(address, f"http://127.0.0.1:{http_port}", supervisor, names)


def _worker(name: str, address: str, slots: int, folder: Path) -> tuple[str, ...]:
    own = [f"--slots={slots}", f"--name={name}", f"--cache-dir={folder / 'cache' / name}"]
    return embomatrix_command("worker", "run", f"--manager={address}", *own)


def without_membership(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment without what a person set for another cluster: this one is open, and speaks no TLS."""
    return {name: value for name, value in environment.items() if name not in MEMBERSHIP}


def free_port() -> int:
    """A TCP port of the loopback interface that nobody listened on a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
