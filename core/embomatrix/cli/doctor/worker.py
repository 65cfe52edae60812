"""Findings about this machine as a worker: resources that it would offer, and a start of the simulator."""

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path

from embomatrix.cli.doctor.machine import Finding, Level
from embomatrix.worker.host.resources import measure
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.slots.processes import ProcessGoneError, start_root


def worker() -> Iterator[Finding]:
    """Measure the resources and start the simulator."""
    settings = WorkerSettings.model_validate({})
    offered = measure(settings)
    yield Finding("engine", Level.FINE, "pybullet {pybullet}, platform {platform}".format(**offered.versions))
    yield Finding(
        "slots", Level.FINE, f"{offered.slots}, one per core, {offered.score:.2f} of the reference speed"
    )
    yield Finding("memory for scenes", Level.FINE, f"{offered.memory_mb:,} MB")
    yield Finding("disk for bundles", Level.FINE, f"{offered.disk_mb:,} MB")
    gpu = f"{offered.gpu}, {offered.vram_mb:,} MB" if offered.gpu else "none (not needed)"
    yield Finding("GPU", Level.FINE, gpu)
    try:
        started_s, memory_mb = asyncio.run(_start_simulator(settings.cache_dir.expanduser() / "doctor.log"))
    except (ProcessGoneError, OSError) as error:
        yield Finding("simulator", Level.WRONG, "does not start", str(error))
    else:
        yield Finding("simulator", Level.FINE, f"starts in {started_s:.1f} s, {memory_mb:.0f} MB")


async def _start_simulator(log: Path) -> tuple[float, float]:
    """Return the duration of the start in seconds, and the memory of the simulator in MB. The log stays for the user."""
    log.parent.mkdir(parents=True, exist_ok=True)
    started_s = time.monotonic()
    root = await start_root(log)
    elapsed_s = time.monotonic() - started_s
    await root.end()
    return elapsed_s, root.memory_mb
