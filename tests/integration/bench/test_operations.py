"""`bench operations` with a stand-in for Docker Compose."""

import sys

import pytest

from embomatrix.bench.cluster.processes import output_of
from embomatrix.bench.operations.compose import PROJECT, Compose
from embomatrix.bench.report.figures import BenchError


@pytest.fixture
def compose(tmp_path):
    """Return a compose file whose command prints its project and file, and fails for `up`."""
    script = tmp_path / "compose"
    script.write_text(
        '#!/bin/sh\necho "$COMPOSE_PROJECT_NAME $COMPOSE_FILE $MANAGER_PORT $*"\ntest "$1" != up\n'
    )
    script.chmod(0o755)
    return Compose(tmp_path, (str(script),), 7001, 7002)


def test_compose_has_a_project_and_ports_of_its_own(compose):
    assert compose.run("ps", "-q").split() == [
        PROJECT,
        str(compose.folder / "docker-compose.yml"),
        "7001",
        "ps",
        "-q",
    ]


def test_failed_compose_command_is_named(compose):
    with pytest.raises(BenchError, match=r"compose up -d --no-build …` failed"):
        compose.run("up", "-d", "--no-build")


def test_command_ends_at_the_limit_of_its_caller():
    with pytest.raises(BenchError, match=r"timed out after 0\.1 seconds"):
        output_of(sys.executable, "-c", "import time; time.sleep(60)", limit_s=0.1)
