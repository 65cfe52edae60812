"""The first NVIDIA GPU of this machine, asked by NVML where its Python package is installed, else by ``nvidia-smi``."""

from __future__ import annotations

import importlib
import shutil
import subprocess
from dataclasses import dataclass
from typing import Final

from embomatrix.host.cgroup import MIB

QUERY_S: Final = 5.0
RENDER_MB: Final = 2048
"""Memory of the GPU that one slot which renders is expected to take."""


@dataclass(frozen=True, slots=True)
class Gpu:
    """An empty name and no memory: there is none."""

    name: str = ""
    vram_mb: int = 0

    def render_slots(self, slots: int) -> int:
        """How many of the slots may render at the same time."""
        return min(slots, self.vram_mb // RENDER_MB) if self.name else 0


def find_gpu() -> Gpu:
    """Name and memory of the first GPU. Nothing that is missing or broken is an error: rollouts need no GPU."""
    return ask_nvml() or ask_program() or Gpu()


def ask_nvml() -> Gpu | None:
    """By the driver's own library, through the package nvidia-ml-py; None without package, driver or GPU."""
    try:
        nvml = importlib.import_module("pynvml")
    except ImportError:
        return None
    try:
        nvml.nvmlInit()
    except nvml.NVMLError:
        return None
    try:
        device = nvml.nvmlDeviceGetHandleByIndex(0)
        name = nvml.nvmlDeviceGetName(device)
        memory = nvml.nvmlDeviceGetMemoryInfo(device)
        # Packages before 11.5 answer in bytes.
        return Gpu(name.decode() if isinstance(name, bytes) else name, memory.total // MIB)
    except nvml.NVMLError:
        return None
    finally:
        nvml.nvmlShutdown()


def ask_program() -> Gpu | None:
    """By ``nvidia-smi``, which comes with the driver; None where there is none, or where it fails."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return None
    query = [program, "--query-gpu=name,memory.total", "--format=csv,noheader,nounits"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=QUERY_S, check=True)
        name, memory_mb = answer.stdout.splitlines()[0].rsplit(",", 1)
        return Gpu(name.strip(), int(memory_mb))
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None
