"""Shrink an installed environment: remove files that a service never reads, and compile the modules that it imports.

PyBullet's wheel carries 130 MB of debugging symbols and many robot models, of which one arm is used here.

Usage, with the environment's Python: slim.py [--keep-samples] MODULE [MODULE ...], where the modules are those that the service
imports. With --keep-samples, the shipped tasks, the shipped policy and the workloads of benchmarks stay.
"""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Final

NEVER_READ: Final = (
    "**/tests",
    "numpy/**/*.a",
    "numpy/**/*.pyi",
    "pybullet_envs",
    "pybullet_examples",
    "pybullet_robots",
    "torch/include",
    "torch/share",
    "torch/test",
    "**/*.pyc",
)
SAMPLES: Final = ("embomatrix/bench/data", "embomatrix/starter/policy", "embomatrix/starter/*.xz")
STRIPPED: Final = ("pybullet*.so", "grpc/**/*.so", "cryptography/**/*.so")
"""Libraries with symbols. Stripping breaks the libraries in ``*.libs`` folders, which were edited after linking."""
ARM: Final = "franka_panda"
"""Folder of ``pybullet_data`` with the robot's arm; the other models are removed."""


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def slim(packages: Path, unused: tuple[str, ...]) -> None:
    """Remove unused files below the folder of installed packages, and strip its libraries."""
    for pattern in unused:
        for path in sorted(packages.glob(pattern)):
            _remove(path)
    models = packages / "pybullet_data"
    if models.is_dir():
        for path in models.iterdir():
            if path.name != ARM and path.suffix != ".py":
                _remove(path)
    for pattern in STRIPPED:
        for library in packages.glob(pattern):
            subprocess.run(["strip", "--strip-unneeded", str(library)], check=True)


if __name__ == "__main__":
    names = [argument for argument in sys.argv[1:] if argument != "--keep-samples"]
    kept = len(names) < len(sys.argv) - 1
    slim(Path(sysconfig.get_path("purelib")), NEVER_READ if kept else (*NEVER_READ, *SAMPLES))
    for name in names:
        importlib.import_module(name)
