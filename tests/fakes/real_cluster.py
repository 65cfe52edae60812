"""Cluster of real processes that a test starts, kills and counts."""

import asyncio
import collections
import contextlib
import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

from tests.fakes import waiting

from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Batch, Completed, InfraFailure, Rollout
from embomatrix.world.inflation import bundle_digest

FAKES = Path(__file__).parent
LIMITS = ClientLimits(retry_first_s=0.05, retry_longest_s=0.5)
SCENE = zlib.compress(b"ok")
DIGEST = bundle_digest(SCENE)


class RealCluster:
    """Context manager that kills all remaining processes at its end. ``settings`` apply to every manager."""

    def __init__(self, folder, **settings):
        self.folder = folder
        self.settings = settings
        self.ports = {}
        self.processes = {}
        self.executions = folder / "executions.txt"

    def __enter__(self):
        self.executions.touch()
        return self

    def __exit__(self, *_):
        for process in self.processes.values():
            process.kill()
            process.wait()

    @property
    def address(self):
        """Return the addresses of all started managers, separated by commas."""
        return ",".join(f"127.0.0.1:{port}" for port in self.ports.values())

    def start_manager(self, name="manager", **settings):
        port = self.ports.setdefault(name, free_port())
        chosen = {
            "port": port,
            "http_port": 0,
            "data_dir": str(self.folder / "manager"),
            "state": f"sqlite:{self.folder / 'state.sqlite'}",
            **self.settings,
            **settings,
        }
        self._start(name, str(FAKES / "manager_process.py"), json.dumps(chosen))

    def start_worker(self, name, slots=2, manager="", lies=0.0, **wishes):
        """Start a daemon with the physics-free simulation, which records the start of each execution.

        The daemon fabricates the reward of the share ``lies`` of its rollouts.
        """
        arguments = (manager or self.address, name, str(self.folder / name), str(slots))
        self._start(name, str(FAKES / "worker_process.py"), *arguments, json.dumps(wishes), str(lies))

    def type_at(self, name):
        """Simulate input of the owner at this worker's machine, now."""
        terminal = self.folder / name / "devices" / "pts" / "0"
        terminal.parent.mkdir(parents=True, exist_ok=True)
        terminal.touch()

    def start_quick_worker(self, name, slots=4, execute_s=0.01):
        """Start a null worker, which accepts as many rollouts as the manager can dispatch."""
        arguments = (self.address, name, str(slots), str(execute_s))
        self._start(name, str(FAKES / "quick_worker_process.py"), *arguments)

    def start_real_worker(self, name, slots=1):
        arguments = (f"--manager={self.address}", f"--name={name}", f"--slots={slots}", "--nice=0")
        cache = f"--cache-dir={self.folder / name}"
        self._start(name, "-m", "embomatrix.cli", "worker", "run", *arguments, cache)

    def start_program(self, name, *command, **environment):
        """Start a worker in another language in the cluster's folder; appends addresses and name to the command."""
        self._run(name, *map(str, command), self.address, name, cwd=self.folder, **environment)

    def start_trainer(self, name, batch, task, out):
        """Start a trainer that submits or resumes the batch and writes each result to the file ``out``."""
        arguments = (self.address, batch.run_id, str(len(batch.rollouts)), task, str(out))
        self._start(name, str(FAKES / "trainer_process.py"), *arguments)

    def signal(self, name, number=signal.SIGKILL):
        """Send a signal and return the wall-clock time. Waits for the end of a killed process."""
        process = self.processes[name]
        process.send_signal(number)
        at_s = time.time()
        if number == signal.SIGKILL:
            del self.processes[name]
            process.wait()
        return at_s

    def log(self, name):
        return (self.folder / f"{name}.log").read_text()

    def logged_s(self, name, pattern, after_s):
        """Return the wall-clock time of the manager's first log line after ``after_s`` that matches; None without one."""
        for line in self.log(name).splitlines():
            found = re.match(r"(\d+\.\d+) (.*)", line)
            if found and float(found[1]) >= after_s and re.search(pattern, found[2]):
                return float(found[1])
        return None

    def executed(self):
        """Count the starts of each rollout on the daemons."""
        return collections.Counter(self.executions.read_text().split())

    def client(self, **options):
        return ClusterClient(self.address, **{"limits": LIMITS, **options})

    def _start(self, name, *arguments):
        self._run(name, sys.executable, *arguments)

    def _run(self, name, *command, cwd=None, **environment):
        root = str(Path(__file__).parents[2])
        paths = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), root)))
        known = {"FAKE_EXECUTIONS": str(self.executions), "PYTHONPATH": paths, **environment}
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                command, stdout=log, stderr=log, env={**os.environ, **known}, cwd=cwd
            )


async def connected(client, *names, limit_s=60.0):
    """Wait until these workers are ready and return the seconds that it took."""
    began_s = time.monotonic()
    async with asyncio.timeout(limit_s):
        while True:
            with contextlib.suppress(ClusterError):
                workers = await client.list_workers()
                if {worker.worker_id for worker in workers if worker.state == "ready"} >= set(names):
                    return time.monotonic() - began_s
            await asyncio.sleep(0.05)


@contextlib.contextmanager
def one_real_worker(folder):
    """Cluster of a manager and one worker that executes plans, connected."""

    async def ready(cluster):
        async with cluster.client() as client:
            await connected(client, "w1")

    with RealCluster(folder) as started:
        started.start_manager()
        started.start_real_worker("w1")
        asyncio.run(ready(started))
        yield started


@contextlib.asynccontextmanager
async def two_workers(folder, **settings):
    """Start a cluster with the ready workers ``w1`` and ``w2``, and a client."""
    with RealCluster(folder, **settings) as cluster:
        cluster.start_manager()
        for name in ("w1", "w2"):
            cluster.start_worker(name)
        async with cluster.client() as client:
            await connected(client, "w1", "w2")
            yield cluster, client


until = functools.partial(waiting.until, limit_s=60.0)


def batch_of(run_id, count, task="ok", batch_id="b1", group=8):
    """Return a batch without equal rollouts: each is executed."""
    rollouts = tuple(
        Rollout(f"{batch_id}-{number}", f"g{number // group}", DIGEST, task, (), number)
        for number in range(count)
    )
    return Batch(run_id, batch_id, 0, rollouts)


async def opened(client, run_id="run", **options):
    """Open a run and upload its only scene."""
    await client.put_bundles({DIGEST: SCENE})
    return await client.open_run("reliability", run_id, **options)


async def outcomes(client, batch, *, then=lambda count: None, deadline_s=120.0):
    """Return every result of the batch in order of arrival. Calls ``then`` with the count after each result."""
    results = []
    async for result in client.execute(batch, deadline_s=deadline_s):
        results.append(result)
        then(len(results))
    return results


@dataclass(frozen=True)
class Tally:
    """Outcomes of a batch as received by its trainer."""

    submitted: int
    delivered: int
    duplicates: int
    infra_failures: int
    fabricated: int

    @property
    def clean(self):
        return self == Tally(self.submitted, self.submitted, 0, 0, 0)


def tally(batch, results, reward=30.5):
    """Count the outcomes. ``reward`` is the true reward or a function of the rollout id; other values are fabricated."""
    counts = collections.Counter(result.rollout_id for result in results)
    expected = reward if callable(reward) else lambda _: reward
    assert set(counts) <= {rollout.rollout_id for rollout in batch.rollouts}
    return Tally(
        submitted=len(batch.rollouts),
        delivered=len(counts),
        duplicates=sum(count - 1 for count in counts.values()),
        infra_failures=sum(isinstance(result.outcome, InfraFailure) for result in results),
        fabricated=sum(
            isinstance(result.outcome, Completed)
            and abs(result.outcome.reward.total - expected(result.rollout_id)) > 1e-9
            for result in results
        ),
    )


def print_figures(name, counted, **figures):
    """Print the figures of a test, for the table in docs/reliability.md."""
    parts = {**vars(counted), **figures}
    text = " ".join(
        f"{key}={value:.2f}" if isinstance(value, float) else f"{key}={value}" for key, value in parts.items()
    )
    print(f"\n{name}: {text}")
