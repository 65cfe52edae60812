"""The compose file on a real Docker engine: redis, manager and workers start, and a batch runs through them."""

import json
import os
import shutil
import ssl
import subprocess
import time
import urllib.request
from pathlib import Path

import pytest

from embomatrix.bench.operations.compose import GOALS_MB

ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.docker, pytest.mark.timeout(1800)]


def _compose(*arguments, check=True, text=True):
    program = ["docker", "compose"] if _has_plugin() else ["docker-compose"]
    return subprocess.run(
        [*program, "-p", "embomatrix-check", "-f", str(ROOT / "docker-compose.yml"), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=text,
        check=check,
        timeout=1500,
    )


def _docker(*arguments):
    return subprocess.run(
        ("docker", *arguments), capture_output=True, text=True, check=True, timeout=60
    ).stdout


def _has_plugin():
    return subprocess.run(["docker", "compose", "version"], capture_output=True, check=False).returncode == 0


def _engine_answers():
    return (
        shutil.which("docker") is not None
        and subprocess.run(["docker", "info"], capture_output=True, check=False).returncode == 0
    )


@pytest.fixture(scope="module")
def cluster():
    if not _engine_answers():
        pytest.skip("no Docker engine answers: start one to check the compose file")
    index = f"TORCH_INDEX={os.environ.get('TORCH_INDEX', '')}"
    for target in GOALS_MB:
        command = ("docker", "build", "--network=host", "--build-arg", index, "--target", target)
        command += ("-t", f"embomatrix/{target}")
        subprocess.run((*command, "-f", "deploy/docker/Dockerfile", "."), cwd=ROOT, check=True, timeout=1500)
    _compose("up", "-d", "--no-build")
    yield Door()
    _compose("down", "--volumes", "--timeout", "20", check=False)


class Door:
    """Client of the published page with the credentials that the init service made."""

    def __init__(self):
        def read(name):
            return _compose("exec", "-T", "manager", "cat", f"/data/access/{name}").stdout

        self._trusted = ssl.create_default_context(cadata=read("ca.pem"))
        self._token = read("tokens/viewer").strip()

    def status(self, path):
        request = urllib.request.Request(
            f"https://127.0.0.1:8070{path}", headers={"Authorization": f"Bearer {self._token}"}
        )
        with urllib.request.urlopen(request, timeout=5, context=self._trusted) as answer:
            return json.load(answer)

    def ready_workers(self):
        return sum(worker["state"] == "ready" for worker in self.status("/api/v1/workers")["items"])


def _until(condition, limit_s=90.0):
    deadline = time.monotonic() + limit_s
    while True:
        try:
            if condition():
                return
        except OSError:
            pass
        assert time.monotonic() < deadline, _compose("logs", "--tail=50", check=False).stdout
        time.sleep(1.0)


def test_two_workers_register_with_the_manager(cluster):
    _until(lambda: cluster.ready_workers() == 2)


def test_images_are_small_and_run_unprivileged_on_a_read_only_system():
    for name, most_mb in GOALS_MB.items():
        if name == "trainer" and "TORCH_INDEX" not in os.environ:
            continue  # builds of torch for GPUs are far larger
        size = int(_docker("image", "inspect", "--format", "{{.Size}}", f"embomatrix/{name}"))
        assert size <= most_mb * 1e6, f"{name} has {size / 1e6:.0f} MB"
    for service in ("redis", "manager", "worker"):
        assert _compose("exec", "-T", service, "id", "-u").stdout.strip() != "0"
        assert _compose("exec", "-T", service, "touch", "/opt/here", check=False).returncode != 0


def test_second_start_changes_nothing_and_workers_scale(cluster):
    before = _compose(
        "exec", "-T", "manager", "sha256sum", "/data/access/ca.pem", "/data/access/tokens/worker"
    ).stdout
    _compose("up", "-d", "--no-build", "--scale", "worker=3")
    _until(lambda: cluster.ready_workers() == 3)
    after = _compose(
        "exec", "-T", "manager", "sha256sum", "/data/access/ca.pem", "/data/access/tokens/worker"
    ).stdout
    assert before == after
    _compose("up", "-d", "--no-build", "--scale", "worker=2")
    _until(lambda: cluster.ready_workers() == 2)


def test_dead_worker_restarts_and_cluster_survives_redis_and_manager_restarts(cluster):
    _until(lambda: cluster.ready_workers() == 2)
    _compose(
        "exec", "-T", "worker", "python", "-c", "import os, signal; os.kill(-1, signal.SIGKILL)", check=False
    )
    _until(lambda: cluster.ready_workers() == 2)
    for service in ("redis", "manager"):
        _compose("restart", service)
        _until(lambda: cluster.ready_workers() == 2)


def test_trainer_container_trains_on_tasks_built_in_a_container(cluster, tmp_path):
    _until(lambda: cluster.ready_workers() == 2)
    assert "holds no tasks yet" in cluster.status("/api/v1/tasks")["notice"]
    _compose(
        "run",
        "--rm",
        "-T",
        "trainer",
        "factory",
        "build",
        "--out=/dataset",
        "--train=12",
        "--heldout=4",
    )
    assert cluster.status("/api/v1/tasks")["total"] == 16
    result = _compose(
        "run",
        "--rm",
        "-T",
        "trainer",
        "train",
        "--steps=3",
        "--imitate-seconds=5",
        "--out=/runs/check",
    )
    assert "success" in result.stdout
    assert "0 lost by the infrastructure" in " ".join(result.stdout.split())
    assert sum(worker["completed"] for worker in cluster.status("/api/v1/workers")["items"]) > 0, (
        "no container executed anything"
    )
    packed = _compose(
        "run", "--rm", "-T", "--no-deps", "--entrypoint=tar", "trainer", "-cC", "/", "runs", text=False
    )
    subprocess.run(("tar", "-xo"), input=packed.stdout, cwd=tmp_path, check=True)
    assert (tmp_path / "runs" / "check" / "report.html").is_file()
