"""The wheel in an empty environment: time from the first command to the first executed plan."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.starter.shipped import SHIPPED

OnStep = Callable[[str], None]

MOST_S: Final = 60.0
PLAY: Final = ("play", "put the apple in the fridge", "--policy", SHIPPED)
LIMIT_S: Final = 600.0


def measure_wheel(checkout: Path, on_step: OnStep) -> Figure:
    """Build the wheel, install it beside this environment's dependencies, and play a shipped task. Raise BenchError."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        on_step("wheel")
        _run(
            [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), str(checkout)]
        )
        environment = install(next((folder / "dist").glob("*.whl")), folder / "environment")
        on_step("first plan")
        (folder / "empty").mkdir()
        began = time.monotonic()
        _run([str(environment / "bin" / "embomatrix"), *PLAY], cwd=folder / "empty", cache=folder / "cache")
        return Figure("wheel_first_plan_s", time.monotonic() - began, "s", Better.LOWER, 1, MOST_S)


def install(wheel: Path, environment: Path) -> Path:
    """Make a virtual environment with a wheel and the dependencies of the running one, without its packages of the clone.

    Raise BenchError.
    """
    _run([sys.executable, "-m", "venv", str(environment)])
    site = next((environment / "lib").glob("python*/site-packages"))
    # Path files in this second folder are not read, so its editable installation of the clone is not seen.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    _run([str(environment / "bin" / "pip"), "install", "--no-index", "--no-deps", str(wheel)])
    return environment


def _run(command: Sequence[str], cwd: Path | None = None, cache: Path | None = None) -> None:
    given = {**os.environ, **({"XDG_CACHE_HOME": str(cache)} if cache is not None else {})}
    done = subprocess.run(
        command, cwd=cwd, env=given, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    if done.returncode:
        raise BenchError(
            f"{' '.join(command[:4])} ended with status {done.returncode}: {done.stderr.strip()[-500:]}"
        )
