"""Makes an installed environment small: what a service never reads is removed, and what it imports is compiled ahead.

The extension of PyBullet's wheel carries 130 MB of debugging symbols; its package of models one arm that is used here.

Usage, by the environment's own Python: slim.py MODULE [MODULE ...], the modules being what the service imports.
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
STRIPPED: Final = ("pybullet*.so", "grpc/**/*.so", "cryptography/**/*.so")
"""Libraries with symbols. Those that a wheel brings in a folder ``*.libs`` were edited after linking and don't survive it."""
ARM: Final = "franka_panda"
"""The model of ``pybullet_data`` that the robot is made of, beside the package's own modules."""


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def slim(packages: Path) -> None:
    """Remove what is never read below the folder of installed packages, and strip its libraries."""
    for pattern in NEVER_READ:
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
    slim(Path(sysconfig.get_path("purelib")))
    for name in sys.argv[1:]:
        importlib.import_module(name)
