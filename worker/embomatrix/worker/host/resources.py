"""Resources of this machine: cores, memory, GPU, versions, and speed."""

from __future__ import annotations

import hashlib
import math
import platform
import shutil
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import psutil

from embomatrix.host.limits import MIB, find_limits, usable_cores
from embomatrix.rpc.wire.values import Resources
from embomatrix.worker.host.gpu import find_gpu

if TYPE_CHECKING:
    from embomatrix.worker.host.settings import WorkerSettings

REFERENCE_S: Final = 0.0065
"""Seconds of the probe on a machine of score 1, a core of a cloud machine of 2026."""


def measure(settings: WorkerSettings) -> Resources:
    """Measure this machine; values in the settings take precedence."""
    limits = find_limits()
    cores = usable_cores(limits)
    slots = settings.slots or cores
    gpu = find_gpu()
    free_mb = min(psutil.virtual_memory().available / MIB, limits.memory_mb)
    return Resources(
        slots=slots,
        cores=cores,
        memory_mb=settings.memory_mb or max(1, int(free_mb * settings.memory_share)),
        score=measure_score(),
        gpu=gpu.name,
        vram_mb=gpu.vram_mb,
        versions=versions(),
        render_slots=gpu.render_slots(slots),
        disk_mb=free_disk_mb(settings.cache_dir.expanduser()),
        labels=settings.labels,
    )


def free_disk_mb(folder: Path) -> int:
    """Free disk space in MB at this folder, which may not exist yet."""
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free // MIB


def measure_score() -> float:
    """Speed of one core relative to the reference machine: the best of three short probes in Python."""
    seconds = []
    for _ in range(3):
        started_s = time.perf_counter()
        total = 0.0
        for number in range(200_000):
            total += number * 0.5
        seconds.append(time.perf_counter() - started_s)
    return round(REFERENCE_S / min(seconds), 2)


def versions() -> dict[str, str]:
    """Versions that affect results, and the platform's fingerprint."""
    return {
        "embomatrix": _version_of("embomatrix"),
        "python": platform.python_version(),
        "pybullet": _version_of("pybullet"),
        "numpy": np.__version__,
        "platform": fingerprint(),
    }


def fingerprint() -> str:
    """Fingerprint of engine wheel, libm and numpy: where it is equal, equal rollouts have bit-equal traces."""
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
