"""Check of a unit file by systemd itself."""

import os
import shutil
import subprocess

import pytest

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None,
    reason="needs systemd-analyze, which says whether a unit is valid",
)


def assert_valid_unit(path, *, system):
    """Assert that systemd reports no warning about this system or user unit."""
    scope = [] if system else ["--user"]
    result = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *scope, str(path)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "XDG_RUNTIME_DIR": str(path.parent)},
    )
    assert (result.returncode, result.stderr) == (0, "")
