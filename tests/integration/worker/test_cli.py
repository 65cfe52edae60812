"""Command line of the worker: one sentence and status 2 for every user error."""

import subprocess
import sys


def _worker(*arguments, prelude="", command=("worker",)):
    program = f"import sys\n{prelude}\nsys.argv = ['embomatrix', *{command!r}, *{arguments!r}]\n"
    program += "from embomatrix.cli.main import main\nmain()\n"
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )


def test_missing_engine_is_reported_with_the_install_command():
    # Only the wheel is hidden: the rest of the installation is the real one.
    hidden = (
        "import importlib.machinery as m\n"
        "class Finder(m.PathFinder):\n"
        "    @classmethod\n"
        "    def find_spec(cls, name, path=None, target=None):\n"
        "        return None if name == 'pybullet' else super().find_spec(name, path, target)\n"
        "sys.meta_path[:] = [Finder if f is m.PathFinder else f for f in sys.meta_path]\n"
    )
    result = _worker("run", prelude=hidden)
    assert result.returncode == 2
    assert "needs the physics engine pybullet" in result.stderr
    assert "pip install 'embomatrix[worker]'" in result.stderr
    assert "Traceback" not in result.stderr


def test_absent_manager_is_named_with_once(tmp_path):
    result = _worker("run", "--once", "--manager=127.0.0.1:1", f"--cache-dir={tmp_path}")
    assert result.returncode == 2
    assert "no manager answers at 127.0.0.1:1: start one with `embomatrix manager serve`" in result.stderr
    assert "Traceback" not in result.stderr


def test_wrong_option_is_named_with_the_expected_value():
    result = _worker("run", "--slots=-3")
    assert result.returncode == 2
    assert "--slots -3" in result.stderr
    assert "greater than or equal to 0" in result.stderr


def test_wrong_address_is_reported_with_an_example():
    result = _worker("run", "--manager=nowhere")
    assert result.returncode == 2
    assert "--manager 'nowhere': expected HOST:PORT, as in 127.0.0.1:50070" in result.stderr


def test_doctor_reports_resources_and_starts_the_simulator():
    result = _worker(command=("doctor",))
    assert result.returncode == 0
    assert "pybullet 3.2.7" in result.stdout
    assert "starts in" in result.stdout
