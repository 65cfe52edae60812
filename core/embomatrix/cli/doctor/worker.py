"""Findings about this machine as a worker: resources that it would offer, and a start of the simulator."""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from embomatrix.cli.doctor.machine import Finding, Level
from embomatrix.worker.host.resources import measure
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.slots.processes import ProcessGoneError, start_root


def worker() -> Iterator[Finding]:
    """Measure the resources and start the simulator."""
    offered = measure(WorkerSettings.model_validate({}))
    yield Finding("engine", Level.FINE, "pybullet {pybullet}, platform {platform}".format(**offered.versions))
    yield Finding(
        "slots", Level.FINE, f"{offered.slots}, one per core, {offered.score:.2f} of the reference speed"
    )
    yield Finding("memory for scenes", Level.FINE, f"{offered.memory_mb:,} MB")
    yield Finding("disk for bundles", Level.FINE, f"{offered.disk_mb:,} MB")
    gpu = f"{offered.gpu}, {offered.vram_mb:,} MB" if offered.gpu else "none (not needed)"
    yield Finding("GPU", Level.FINE, gpu)
    try:
        started_s, memory_mb = asyncio.run(_start_simulator())
    except ProcessGoneError as error:
        yield Finding("simulator", Level.WRONG, "does not start", str(error))
    else:
        yield Finding("simulator", Level.FINE, f"starts in {started_s:.1f} s, {memory_mb:.0f} MB")


async def _start_simulator() -> tuple[float, float]:
    """Return the duration of the start in seconds, and the memory of the simulator in MB."""
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        root = await start_root(Path(folder) / "simulator.log")
        elapsed_s = time.monotonic() - started_s
        await root.end()
    return elapsed_s, root.memory_mb
