"""The `embomatrix` command: help and errors, without importing a service."""

import subprocess
import sys


def _run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "embomatrix.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_help_lists_every_subcommand():
    result = _run("--help")
    assert result.returncode == 0
    for name in ("demo", "factory", "scene", "play", "manager", "worker", "train", "eval", "model", "bench"):
        assert f" {name} " in result.stdout


def test_help_loads_neither_torch_nor_pybullet_nor_grpc():
    program = (
        "import sys; sys.argv = ['embomatrix', '--help']\n"
        "from embomatrix.cli.main import main; main()\n"
        "print([name for name in ('torch', 'pybullet', 'grpc', 'fastapi', 'redis') if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert result.stdout.strip().endswith("[]")


def test_misspelt_command_names_the_nearest_one():
    result = _run("trian")
    assert result.returncode == 2
    assert "did you mean `train`?" in result.stderr
    assert "Traceback" not in result.stderr


def test_every_command_explains_itself():
    for name in ("demo", "factory", "scene", "play", "manager", "worker", "train", "eval", "model", "bench"):
        result = _run(name, "--help")
        assert result.returncode == 0, result.stderr
        assert "Usage" in result.stdout


def test_unknown_option_exits_with_status_two():
    result = _run("demo", "--wrokers=3")
    assert result.returncode == 2
    assert "No such option" in result.stderr
    assert "Traceback" not in result.stderr
