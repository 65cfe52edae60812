"""First NVIDIA GPU of this machine, as ``nvidia-smi`` reports it. Rollouts need no GPU."""

import shutil
import subprocess
from dataclasses import dataclass
from typing import Final

QUERY_S: Final = 5.0
RENDER_MB: Final = 2048
"""Expected GPU memory of one rendering slot."""


@dataclass(frozen=True, slots=True)
class Gpu:
    """Name and memory of a GPU; an empty name and no memory without one."""

    name: str = ""
    vram_mb: int = 0

    def render_slots(self, slots: int) -> int:
        """Number of the slots that may render at the same time."""
        return min(slots, self.vram_mb // RENDER_MB) if self.name else 0


def find_gpu() -> Gpu:
    """Return the first GPU. A missing or failing ``nvidia-smi`` is no error."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return Gpu()
    query = [program, "--query-gpu=name,memory.total", "--format=csv,noheader,nounits"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=QUERY_S, check=True)
        name, memory_mb = answer.stdout.splitlines()[0].rsplit(",", 1)
        return Gpu(name.strip(), int(memory_mb))
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return Gpu()
