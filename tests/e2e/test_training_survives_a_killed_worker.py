"""The whole path with real processes: factory, cluster, trainer; one worker is killed in the middle."""

import json
import os
import re
import signal
import subprocess
import time

import pytest

from embomatrix.cli.local_cluster import local_cluster
from embomatrix.cli.supervisor import embomatrix_command

STEPS = 30
pytestmark = pytest.mark.timeout(420)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset")
    _run("factory", "build", f"--out={folder}", "--train=16", "--heldout=4")
    return folder


def test_rollouts_of_a_killed_worker_are_executed_elsewhere_and_none_is_lost(dataset, tmp_path):
    out = tmp_path / "run"
    cluster = local_cluster(tmp_path / "cluster", workers=2, slots=1)
    with cluster.supervisor as children:
        trainer = subprocess.Popen(
            _training(dataset, cluster.address, out), text=True, stdout=subprocess.PIPE
        )
        _until(lambda: len(_metrics(out)) >= 3, trainer)
        os.kill(children.pid("worker-1"), signal.SIGKILL)
        told, _ = trainer.communicate(timeout=240)
        assert trainer.returncode == 0, told
        assert children.restarts("worker-1") == 1
        assert children.restarts("worker-2") == children.restarts("manager") == 0
    metrics = _metrics(out)
    assert [line["step"] for line in metrics] == list(range(1, STEPS + 1))
    assert sum(line["lost"] for line in metrics) == 0, "a rollout without a result"
    assert _counted("rollouts, ", told) == sum(line["rollouts"] for line in metrics)
    assert _counted("lost and masked", told) == 0
    assert _counted("re-dispatched", told) >= 1, "the kill hit no rollout: the test shows nothing"
    assert (out / "report.html").exists()


def test_equal_plans_of_a_group_have_equal_rewards_on_any_worker(dataset, tmp_path):
    out = tmp_path / "run"
    cluster = local_cluster(tmp_path / "cluster", workers=2, slots=1)
    with cluster.supervisor:
        subprocess.run(
            _training(dataset, cluster.address, out), check=True, timeout=240, stdout=subprocess.PIPE
        )
    samples = [json.loads(line) for line in (out / "samples.jsonl").read_text().splitlines()]
    rewards = {}
    for sample in samples:
        rewards.setdefault((sample["step"], sample["task"], sample["text"]), set()).add(sample["reward"])
    assert rewards
    assert all(len(found) == 1 for found in rewards.values())


def _training(dataset, address, out):
    return embomatrix_command(
        "train",
        f"--dataset={dataset}",
        f"--manager={address}",
        f"--steps={STEPS}",
        "--imitate-seconds=8",
        f"--out={out}",
        "--threads=1",
    )


def _run(*arguments):
    subprocess.run(embomatrix_command(*arguments), check=True, timeout=240, stdout=subprocess.PIPE)


def _metrics(out):
    path = out / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _until(condition, process, limit_s=180.0):
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def _counted(what, told):
    """The number that stands before the words in the closing summary."""
    found = re.search(rf"([\d,]+) {what}", " ".join(told.split()))
    assert found, told
    return int(found[1].replace(",", ""))
