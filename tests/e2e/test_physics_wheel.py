"""`make physics-wheel` builds PyBullet for a Python without a wheel on the index, and a plan is executed there."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHONS = ("python3.12", "python3.13")


def newer_python():
    """Path of a newer Python that starts, or None. A manager of versions leaves commands that only print an error."""
    for name in PYTHONS:
        path = shutil.which(name)
        if path and subprocess.run([path, "--version"], capture_output=True, check=False).returncode == 0:
            return path
    return None


def run(*command, cwd=ROOT):
    """Run without the clone's modules and without the environment of the tests."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_worker_executes_plans_on_a_newer_python(tmp_path):
    python = newer_python()
    if python is None:
        pytest.skip(f"needs one of {', '.join(PYTHONS)}")
    built = run("deploy/physics/build_wheel.sh", python, str(tmp_path / "dist")).strip()
    run(python, "-m", "venv", str(tmp_path / "venv"))
    tools = tmp_path / "venv" / "bin"
    run(str(tools / "pip"), "install", "--quiet", built)
    run(str(tools / "pip"), "install", "--quiet", f"{ROOT}[worker]")
    played = run(str(tools / "embomatrix"), "play", "turn on the floor lamp", "--oracle", cwd=tmp_path)
    assert "success" in played


def test_missing_python_is_named():
    done = subprocess.run(
        ["deploy/physics/build_wheel.sh", "python9.9"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == (
        "physics-wheel: python9.9 was not found: pass the Python to build for, as in make physics-wheel PYTHON=python3.12\n"
    )
