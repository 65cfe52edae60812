"""Factory, cluster and trainer as real processes; one worker is killed during training."""

import json
import os
import re
import signal
import subprocess
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.fakes.waiting import until_listening

from embomatrix.cli.local_cluster import local_cluster
from embomatrix.cli.supervisor import embomatrix_command

STEPS = 12
HOLD_S = 2.8
"""Shorter than the silence after which the manager gives a worker nothing."""
REPORTED_S = 1.5
"""Delay after which the manager's report reflects the stopped workers."""
NOTICED_S = 1.5
"""A worker whose connection broke is given up after a second."""
pytestmark = pytest.mark.timeout(1200)


@dataclass(frozen=True)
class Run:
    """Output and files of a training run whose first worker was killed during it."""

    output: str
    out: Path
    metrics: list[dict[str, float]]
    restarts: dict[str, int]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    dataset, out = folder / "dataset", folder / "out"
    _run("factory", "build", f"--out={dataset}", "--train=8", "--heldout=2", "--no-reachability")
    cluster = local_cluster(folder / "cluster", workers=2, slots=1)
    with cluster.supervisor as children:
        until_listening(cluster.address)
        trainer = subprocess.Popen(
            _training(dataset, cluster.address, out), text=True, stdout=subprocess.PIPE
        )
        _until(lambda: len(_metrics(out)) >= 2, trainer)
        # Rollouts take milliseconds, and others soon take over what a stopped worker holds: with both of them
        # stopped, the first holds what it was given until it dies.
        both = [children.pid("worker-1"), children.pid("worker-2")]
        _until(lambda: _stopped_with_work(both, cluster.dashboard), trainer)
        os.kill(both[0], signal.SIGKILL)
        # Until the manager notices: otherwise the other worker would steal the dead worker's queued leases.
        time.sleep(NOTICED_S)
        os.kill(both[1], signal.SIGCONT)
        output, _ = trainer.communicate(timeout=600)
        assert trainer.returncode == 0, output
        restarts = {name: children.restarts(name) for name in ("manager", *cluster.workers)}
    return Run(output, out, _metrics(out), restarts)


def test_rollouts_of_a_killed_worker_are_redispatched_and_none_is_lost(run):
    assert run.restarts == {"manager": 0, "worker-1": 1, "worker-2": 0}
    assert [line["step"] for line in run.metrics] == list(range(1, STEPS + 1))
    assert sum(line["lost"] for line in run.metrics) == 0, "a rollout without a result"
    assert _counted("rollouts, ", run.output) == sum(line["rollouts"] for line in run.metrics)
    assert _counted("lost by the infrastructure", run.output) == 0
    assert _counted("re-dispatched", run.output) >= 1, "the kill hit no rollout: the test shows nothing"


def test_equal_plans_have_equal_rewards_on_any_worker(run):
    rewards = {}
    for line in (run.out / "samples.jsonl").read_text().splitlines():
        sample = json.loads(line)
        rewards.setdefault((sample["step"], sample["task"], sample["text"]), set()).add(sample["reward"])
    assert rewards
    assert all(len(found) == 1 for found in rewards.values())


def test_run_ends_with_report_and_checkpoint(run):
    assert (run.out / "report.html").read_text().count("<svg") >= 2
    assert any((run.out / "checkpoints").glob(f"step-*{STEPS}"))


def _training(dataset, address, out):
    return embomatrix_command(
        "train",
        f"--dataset={dataset}",
        f"--manager={address}",
        f"--steps={STEPS}",
        "--imitate-seconds=6",
        f"--out={out}",
        "--threads=1",
    )


def _run(*arguments):
    subprocess.run(embomatrix_command(*arguments), check=True, timeout=600, stdout=subprocess.PIPE)


def _metrics(out):
    path = out / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _stopped_with_work(pids, dashboard):
    """Stop the workers and return True if the first one holds queued leases; otherwise continue them.

    A running lease may be hedged; a queued lease has no second copy, so only a re-dispatch can finish it.
    """
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    ends_s = time.monotonic() + HOLD_S
    time.sleep(REPORTED_S)
    while time.monotonic() < ends_s:
        with urllib.request.urlopen(f"{dashboard}/api/v1/workers", timeout=10) as answer:
            workers = json.load(answer)["items"]
        if any(worker["worker_id"].startswith("worker-1") and worker["waiting"] for worker in workers):
            return True
        time.sleep(0.05)
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    return False


def _until(condition, process, limit_s=180.0):
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def _counted(what, output):
    """Return the number before these words in the closing summary."""
    found = re.search(rf"([\d,]+) {what}", " ".join(output.split()))
    assert found, output
    return int(found[1].replace(",", ""))
