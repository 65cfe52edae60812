"""What this machine offers: cores, memory, GPU, versions, and how fast it is."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import shutil
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Final

import numpy as np
import psutil

from embomatrix.rpc.values import Resources
from embomatrix.sim.zygote import MIB

if TYPE_CHECKING:
    from embomatrix.worker.settings import WorkerSettings

MEMORY_SHARE: Final = 0.4
"""Share of the free memory that residents may use when nothing else is said."""
REFERENCE_S: Final = 0.0065
"""Seconds that the probe takes on a machine of score 1: a core of a cloud machine of 2026."""
GPU_QUERY_S: Final = 5.0


def measure(settings: WorkerSettings) -> Resources:
    """Resources of this machine; what the settings name is taken from there."""
    gpu, vram_mb = find_gpu()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    free_mb = psutil.virtual_memory().available // MIB
    return Resources(
        slots=settings.slots or cores,
        cores=cores,
        memory_mb=settings.memory_mb or max(1, int(free_mb * MEMORY_SHARE)),
        score=measure_score(),
        gpu=gpu,
        vram_mb=vram_mb,
        versions=versions(),
    )


def measure_score() -> float:
    """Speed of one core, 1 for the reference machine: the best of three short probes of plain Python."""
    seconds = []
    for _ in range(3):
        started_s = time.perf_counter()
        total = 0.0
        for number in range(200_000):
            total += number * 0.5
        seconds.append(time.perf_counter() - started_s)
    return round(REFERENCE_S / min(seconds), 2)


def find_gpu() -> tuple[str, int]:
    """Name and memory (MiB) of the first NVIDIA GPU, or an empty name."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return "", 0
    query = [program, "--query-gpu=name,memory.total", "--format=csv,noheader,nounits"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=GPU_QUERY_S, check=True)
        name, memory_mb = answer.stdout.splitlines()[0].rsplit(",", 1)
        return name.strip(), int(memory_mb)
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return "", 0


def versions() -> dict[str, str]:
    """Versions that results depend on, and the platform's fingerprint."""
    return {
        "embomatrix": _version_of("embomatrix"),
        "python": platform.python_version(),
        "pybullet": _version_of("pybullet"),
        "numpy": np.__version__,
        "platform": fingerprint(),
    }


def fingerprint() -> str:
    """Equal on machines where equal rollouts have bit-equal traces: engine wheel, libm and numpy are probed."""
    probe = hashlib.sha256()
    probe.update(f"{platform.machine()} {_version_of('pybullet')} {np.__version__}".encode())
    for number in (0.1, 0.7, 1.3, 2.9, 1e5):
        values = (math.sin(number), math.cos(number), math.atan2(number, 3.0), math.exp(-number), number**0.3)
        probe.update(" ".join(value.hex() for value in values).encode())
    ramp = np.linspace(0.0, 3.0, 257)
    probe.update(np.sin(ramp).tobytes())
    probe.update(np.float64(np.sqrt(ramp).sum()).tobytes())
    probe.update((ramp[:256].reshape(16, 16) @ ramp[1:].reshape(16, 16)).tobytes())
    return probe.hexdigest()[:16]


def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
