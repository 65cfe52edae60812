"""Ray actors as workers: they join a manager, execute, restart after a process loss, and end with Ray."""

import contextlib
import re
import signal
import time

import psutil
import pytest
from tests.fakes.commands import background

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(autouse=True)
def with_ray():
    pytest.importorskip("ray", reason="install embomatrix[ray] to place workers with it")


def daemons(name):
    """Return the worker daemon's processes with this name."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            line = process.cmdline()
            if "run" in line and name in line and "worker" in line:
                found.append(process)
    return found


def until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.2)
    return found


async def test_worker_on_ray_executes_and_restarts_after_a_loss(kitchen, tmp_path):
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    digest, task_id = record.bundle_digest, record.task.task_id
    plan = plan_from_json(list(record.oracle))
    name = f"placed-{tmp_path.name}"
    serve = ("manager", "serve", "--port=0", "--http-port=0", "--state=memory:", f"--data-dir={tmp_path}")
    with background(tmp_path / "manager.log", *serve) as manager:
        manager.wait_for("status page")
        address = re.search(r"manager serves at (\S+),", manager.text)[1]
        place = ("worker", "ray", "--address=local", f"--prefix={name}", "--memory-mb=1024")
        with background(tmp_path / "ray.log", *place, "--", f"--manager={address}") as ray:
            (first,) = until(lambda: daemons(f"{name}-0"))
            async with ClusterClient(address) as client:
                run_id = await client.open_run("placed")
                await client.put_bundles({digest: dataset.bundle_bytes(digest)})
                for part in ("before", "after"):
                    rollouts = tuple(Rollout(f"{part}-{n}", part, digest, task_id, plan, 0) for n in range(4))
                    batch = Batch(run_id, part, 1, rollouts)
                    results = [item async for item in client.execute(batch, deadline_s=120)]
                    assert all(isinstance(result.outcome, Completed) for result in results)
                    if part == "before":
                        first.send_signal(signal.SIGKILL)
                        until(lambda: [each for each in daemons(f"{name}-0") if each.pid != first.pid])
            ray.process.send_signal(signal.SIGINT)
            until(lambda: not daemons(f"{name}-0"))
