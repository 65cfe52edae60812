"""Limits of this process: control groups and CPU affinity."""

import os
import signal
import subprocess
import sys

import psutil
import pytest

from embomatrix.host.limits import Limits, find_limits, usable_cores


def _group(mount, name, **files):
    folder = mount / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file.replace("__", ".")).write_text(text + "\n")


def test_tightest_cgroup_counts(tmp_path):
    mount, membership = tmp_path / "cgroup", tmp_path / "membership"
    membership.write_text("0::/user.slice/worker.service\n")
    _group(mount, "user.slice/worker.service", cpu__max="max 100000", memory__max="max", memory__current="5")
    _group(
        mount, "user.slice", cpu__max="250000 100000", memory__max=str(3 << 30), memory__current=str(1 << 30)
    )
    assert find_limits(mount, membership) == Limits(2.5, 2048.0)


def test_cgroups_of_version_1_count(tmp_path):
    mount, membership = tmp_path / "cgroup", tmp_path / "membership"
    membership.write_text("5:memory:/docker/1\n4:cpu,cpuacct:/docker/1\n")
    _group(mount, "cpu,cpuacct/docker/1", cpu__cfs_quota_us="150000", cpu__cfs_period_us="100000")
    _group(mount, "cpu,cpuacct", cpu__cfs_quota_us="-1", cpu__cfs_period_us="100000")
    _group(mount, "memory", memory__limit_in_bytes=str(1 << 30), memory__usage_in_bytes="0")
    assert find_limits(mount, membership) == Limits(1.5, 1024.0)


@pytest.mark.parametrize(
    ("membership", "files"),
    [
        (
            "0::/w\n",
            {"memory__max": str(1 << 30), "memory__current": str(3 << 28), "memory__stat": "inactive_file"},
        ),
        (
            "5:memory:/w\n",
            {
                "memory__limit_in_bytes": str(1 << 30),
                "memory__usage_in_bytes": str(3 << 28),
                "memory__stat": "total_inactive_file",
            },
        ),
    ],
)
def test_inactive_page_cache_counts_as_free(tmp_path, membership, files):
    (tmp_path / "membership").write_text(membership)
    account = f"anon 5\n{files['memory__stat']} {1 << 28}\nfile 7"
    group = "w" if membership.startswith("0") else "memory/w"
    _group(tmp_path / "cgroup", group, **files | {"memory__stat": account})
    assert find_limits(tmp_path / "cgroup", tmp_path / "membership").memory_mb == 512.0


def test_no_limits_without_cgroups(tmp_path):
    assert find_limits(tmp_path, tmp_path / "none") == Limits()


def test_usable_cores_are_the_smaller_of_affinity_and_quota():
    assert usable_cores(Limits(cores=0.5)) == 1
    assert usable_cores(Limits()) == len(psutil.Process().cpu_affinity())
    assert usable_cores() == usable_cores(find_limits())


DIES_WITH_ITS_PARENT = """
import subprocess, sys, time
from signal import SIGTERM
from embomatrix.host.parent import with_this_process
sleeper = [sys.executable, "-c", "import time; time.sleep(300)"]
print(subprocess.Popen(sleeper, preexec_fn=with_this_process(SIGTERM)).pid, flush=True)
time.sleep(300)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's own means")
def test_child_does_not_outlive_a_killed_parent():
    with subprocess.Popen([sys.executable, "-c", DIES_WITH_ITS_PARENT], stdout=subprocess.PIPE) as parent:
        child = psutil.Process(int(parent.stdout.readline()))
        os.kill(parent.pid, signal.SIGKILL)
    child.wait(timeout=30)
    assert not child.is_running()
