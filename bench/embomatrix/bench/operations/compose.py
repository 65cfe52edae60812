"""How long `docker compose up` takes to a first rollout, and how large its images are: by a real Docker engine."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import subprocess
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Batch, Completed, Rollout

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from embomatrix.bench.engine.scenes import BenchScene

PROJECT: Final = "embomatrix-bench"
"""Beside a cluster that somebody runs: with networks, volumes and ports of its own."""
GOALS_MB: Final = {"worker": 400.0, "manager": 200.0}
FIRST_ROLLOUT_S: Final = 60.0
COMMAND_S: Final = 600.0
"""Limit for one command of Docker's."""


@dataclass(frozen=True, slots=True)
class Compose:
    """The compose file of a checkout, and the command that reads it. ``port`` is the manager's on this machine."""

    folder: Path
    command: tuple[str, ...]
    port: int
    page_port: int

    def run(self, *arguments: str) -> str:
        """What it prints. Raises BenchError."""
        ports = {"MANAGER_PORT": str(self.port), "PAGE_PORT": str(self.page_port)}
        told = subprocess.run(
            (*self.command, "-p", PROJECT, "-f", str(self.folder / "docker-compose.yml"), *arguments),
            cwd=self.folder,
            env={**os.environ, **ports},
            capture_output=True,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )
        if told.returncode:
            raise BenchError(f"docker compose {arguments[0]}: {' / '.join(told.stderr.splitlines()[-3:])}")
        return told.stdout


def compose_at(folder: Path) -> Compose:
    """Raises BenchError where there is no compose file, or no engine that answers."""
    if not (folder / "docker-compose.yml").is_file():
        raise BenchError(
            f"{folder} has no docker-compose.yml: run this in a checkout, or name it with --checkout"
        )
    if shutil.which("docker") is None or _fails("docker", "info"):
        raise BenchError("no Docker engine answers: start one, or leave out --part compose and --part images")
    command = ("docker-compose",) if _fails("docker", "compose", "version") else ("docker", "compose")
    return Compose(folder, command, _free_port(), _free_port())


def images() -> tuple[Figure, ...]:
    """Sizes of the images that are there, base and all. Raises BenchError for one that is missing."""
    return tuple(
        Figure(f"image_{name}_mb", _size_mb(name), "MB", Better.LOWER, 1, goal)
        for name, goal in GOALS_MB.items()
    )


def first_rollout(compose: Compose, scene: BenchScene, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Seconds from `docker compose up`, with images that are built and volumes that are new, to the first result."""
    with _down_at_exit(compose):
        on_step("docker compose up")
        started_s = time.monotonic()
        compose.run("up", "-d", "--no-build")
        ca = compose.run("exec", "-T", "manager", "cat", "/data/access/ca.pem")
        token = compose.run("exec", "-T", "manager", "cat", "/data/access/tokens/trainer").strip()
        on_step("the first rollout")
        asyncio.run(_execute_one(f"127.0.0.1:{compose.port}", token, ca.encode("ascii"), scene))
        taken_s = time.monotonic() - started_s
    return (Figure("compose_first_rollout_s", taken_s, "s", Better.LOWER, 1, FIRST_ROLLOUT_S),)


async def _execute_one(address: str, token: str, ca: bytes, scene: BenchScene) -> None:
    """The rollout waits in the manager's queue until a worker is there. Raises BenchError for what is no result."""
    shown = scene.demonstrations[0]
    rollout = Rollout("first", "first", scene.bundle_digest, shown.task_id, shown.plan, 0)
    limits = ClientLimits(batch_s=FIRST_ROLLOUT_S * 2)
    async with ClusterClient(address, token, ca=ca, limits=limits) as client:
        run_id = await client.open_run("bench operations")
        await client.put_bundles({scene.bundle_digest: scene.data})
        try:
            async for result in client.execute(Batch(run_id, "first", 0, (rollout,))):
                if not isinstance(result.outcome, Completed):
                    raise BenchError(f"the first rollout came to {result.outcome}: expected a result")
        except ClusterError as error:
            raise BenchError(f"the first rollout has no result: {error}") from error
        await client.close_run(run_id)


@contextlib.contextmanager
def _down_at_exit(compose: Compose) -> Iterator[None]:
    compose.run("down", "--volumes", "--timeout", "20")
    try:
        yield
    finally:
        compose.run("down", "--volumes", "--timeout", "20")


def _size_mb(name: str) -> float:
    told = subprocess.run(
        ("docker", "image", "inspect", "--format", "{{.Size}}", f"embomatrix/{name}"),
        capture_output=True,
        text=True,
        timeout=COMMAND_S,
        check=False,
    )
    if told.returncode:
        raise BenchError(f"there is no image embomatrix/{name}: build it with `docker compose build`")
    return int(told.stdout) / 1e6


def _fails(*command: str) -> bool:
    return subprocess.run(command, capture_output=True, timeout=COMMAND_S, check=False).returncode != 0


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
