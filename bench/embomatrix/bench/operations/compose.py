"""Docker Compose: sizes of the images, and the time from `docker compose up` to the first rollout."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.processes import output_of
from embomatrix.bench.report.figures import BenchError
from embomatrix.cli.local_cluster import free_port
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Batch, Completed

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload

PROJECT: Final = "embomatrix-bench"
"""Project name, which keeps networks, volumes and ports apart from those of a running cluster."""
GOALS_MB: Final = {"worker": 400.0, "manager": 200.0, "trainer": 1200.0}
"""Largest size of each image. The trainer's holds for CPU builds of torch (``TORCH_INDEX``)."""
CLUSTER_IMAGES: Final = ("worker", "manager")
"""Images that `docker compose up` needs. The trainer's is built with `docker compose --profile trainer build`."""
FIRST_ROLLOUT_GOAL_S: Final = 60.0
COMMAND_S: Final = 600.0
"""Limit for one command of Docker."""


@dataclass(frozen=True, slots=True)
class Compose:
    """Compose file of a checkout, the command that reads it, and free ports of this machine."""

    folder: Path
    command: tuple[str, ...]
    port: int
    page_port: int

    def run(self, *arguments: str) -> str:
        """Run a subcommand and return its output. Raise BenchError if it fails."""
        ports = {"MANAGER_PORT": str(self.port), "PAGE_PORT": str(self.page_port)}
        # Not as options: an error quotes the first words of the command, which would hide the subcommand.
        project = {"COMPOSE_PROJECT_NAME": PROJECT, "COMPOSE_FILE": str(self.folder / "docker-compose.yml")}
        environment = {**os.environ, **ports, **project}
        return output_of(*self.command, *arguments, environment=environment, limit_s=COMMAND_S)


def compose_at(folder: Path) -> Compose | None:
    """The compose file of a checkout; None if there is none, or no Docker engine answers."""
    if not (folder / "docker-compose.yml").is_file() or not _succeeds("docker", "info"):
        return None
    command = ("docker", "compose") if _succeeds("docker", "compose", "version") else ("docker-compose",)
    return Compose(folder, command, free_port(), free_port())


def missing_images() -> list[str]:
    """Images of the cluster that have not been built."""
    return [f"embomatrix/{name}" for name in CLUSTER_IMAGES if _size_mb(name) is None]


def image_sizes() -> tuple[Figure, ...]:
    """Sizes of the images that have been built, base included."""
    return tuple(
        Figure(f"image_{name}_mb", size_mb, "MB", Better.LOWER, 1, goal)
        for name, goal in GOALS_MB.items()
        if (size_mb := _size_mb(name)) is not None
    )


def measure_first_rollout(
    compose: Compose, workload: Workload, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Seconds from `docker compose up` to the first result, with built images and new volumes."""
    with _removed_at_exit(compose):
        on_step("docker compose up")
        started_s = time.monotonic()
        compose.run("up", "-d", "--no-build")
        ca = compose.run("exec", "-T", "manager", "cat", "/data/access/ca.pem")
        token = compose.run("exec", "-T", "manager", "cat", "/data/access/tokens/trainer").strip()
        on_step("the first rollout")
        asyncio.run(_execute_one(f"127.0.0.1:{compose.port}", token, ca.encode("ascii"), workload))
        taken_s = time.monotonic() - started_s
    return (Figure("compose_first_rollout_s", taken_s, "s", Better.LOWER, 1, FIRST_ROLLOUT_GOAL_S),)


async def _execute_one(address: str, token: str, ca: bytes, workload: Workload) -> None:
    """Execute a rollout, which waits in the manager's queue until a worker is there. Raise BenchError if it fails."""
    rollout = workload.sample(1)[0]
    digest = rollout.bundle_digest
    limits = ClientLimits(batch_s=FIRST_ROLLOUT_GOAL_S * 2)
    async with ClusterClient(address, token, ca=ca, limits=limits) as client:
        run_id = await client.open_run("bench operations")
        await client.put_bundles({digest: workload.bundles[digest]})
        try:
            async for result in client.execute(Batch(run_id, "first", 0, (rollout,))):
                if not isinstance(result.outcome, Completed):
                    raise BenchError(f"the first rollout failed: {result.outcome}")
        except ClusterError as error:
            raise BenchError(f"the first rollout has no result: {error}") from error
        await client.close_run(run_id)


@contextlib.contextmanager
def _removed_at_exit(compose: Compose) -> Iterator[None]:
    compose.run("down", "--volumes", "--timeout", "20")
    try:
        yield
    finally:
        compose.run("down", "--volumes", "--timeout", "20")


def _size_mb(name: str) -> float | None:
    inspect = ("docker", "image", "inspect", "--format", "{{.Size}}", f"embomatrix/{name}")
    done = subprocess.run(inspect, capture_output=True, text=True, timeout=COMMAND_S, check=False)
    return None if done.returncode else int(done.stdout) / 1e6


def _succeeds(*command: str) -> bool:
    if shutil.which(command[0]) is None:
        return False
    return subprocess.run(command, capture_output=True, timeout=COMMAND_S, check=False).returncode == 0
