"""The wheel in an empty environment: time from the first command to the first executed plan."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.starter.shipped import SHIPPED

OnStep = Callable[[str], None]

MOST_S: Final = 60.0
EXTRAS: Final = ("worker", "trainer")
"""Extras of the wheel in the measurement."""
PLAY: Final = ("play", "turn on the floor lamp", "--policy", SHIPPED)
LIMIT_S: Final = 600.0
BUILD_TOOLS: Final = ("build", "hatchling", "hatch_vcs")


def measure_wheel(checkout: Path, on_step: OnStep) -> Figure:
    """Build the wheel, install it with ``EXTRAS`` in an empty environment, and play a shipped task. Raise BenchError."""
    missing = [name for name in BUILD_TOOLS if importlib.util.find_spec(name) is None]
    if missing:
        raise BenchError(
            f"the wheel can't be built without {' and '.join(missing)}: `pip install -e '.[bench]'` in the checkout"
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        on_step("wheel")
        _run(
            [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), str(checkout)]
        )
        environment = install(next((folder / "dist").glob("*.whl")), EXTRAS, folder / "environment")
        on_step("first plan")
        (folder / "empty").mkdir()
        began = time.monotonic()
        _run([str(environment / "bin" / "embomatrix"), *PLAY], cwd=folder / "empty", cache=folder / "cache")
        return Figure("wheel_first_plan_s", time.monotonic() - began, "s", Better.LOWER, 1, MOST_S)


def install(wheel: Path, extras: Collection[str], environment: Path) -> Path:
    """Make a virtual environment with a wheel and what its extras require, without a network. Raise BenchError.

    Requirements are links to the files of the running environment; nothing else of it is visible.
    """
    _run([sys.executable, "-m", "venv", str(environment)])
    _run([str(environment / "bin" / "pip"), "install", "--no-index", "--no-deps", str(wheel)])
    site = next((environment / "lib").glob("python*/site-packages"))
    own = next(found for found in distributions(path=[str(site)]) if found.name == "embomatrix")
    for needed in _requirements(own, extras):
        for file in needed.files or ():
            link = site / file
            # Scripts lie outside the folder of packages; only modules are needed.
            if ".." not in file.parts and not link.exists():
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(Path(str(file.locate())).resolve())
    return environment


def _requirements(own: Distribution, extras: Collection[str]) -> Iterator[Distribution]:
    """Yield the installed distributions that ``own`` with the extras requires, directly and through others."""
    waiting: list[tuple[Distribution, frozenset[str]]] = [(own, frozenset(extras))]
    seen = {(own.name, asked) for _, asked in waiting}
    while waiting:
        requiring, asked = waiting.pop()
        if requiring is not own:
            yield requiring
        for line in requiring.requires or ():
            needed = Requirement(line)
            if needed.marker and not any(needed.marker.evaluate({"extra": extra}) for extra in asked or {""}):
                continue
            key = (needed.name, frozenset(needed.extras))
            if key not in seen:
                seen.add(key)
                waiting.append(
                    (own if needed.name == own.name else _installed(needed.name, requiring), key[1])
                )


def _installed(name: str, requiring: Distribution) -> Distribution:
    try:
        return distribution(name)
    except PackageNotFoundError as error:
        raise BenchError(
            f"{requiring.name} requires {name!r}, which is not installed here: `pip install -e '.[bench]'` in the checkout"
        ) from error


def _run(command: Sequence[str], cwd: Path | None = None, cache: Path | None = None) -> None:
    # PYTHONPATH could show the checkout to the environment that must do without it.
    given = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if cache is not None:
        given["XDG_CACHE_HOME"] = str(cache)
    try:
        done = subprocess.run(
            command, cwd=cwd, env=given, capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise BenchError(
            f"{' '.join(command[:4])} took longer than {LIMIT_S:g} s: try again with less beside it"
        ) from error
    if done.returncode:
        raise BenchError(
            f"{' '.join(command[:4])} ended with status {done.returncode}: {done.stderr.strip()[-500:]}"
        )
