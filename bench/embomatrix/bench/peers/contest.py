"""Contest of our cluster with its peers: one engine, one workload and the same cores in one run.

The processes have loaded the scenes before the clock starts. No plan is executed twice in a process before throughput has
been measured.
"""

import contextlib
import importlib.util
import logging
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.bench.cluster.cpu import descendants_cpu_s
from embomatrix.bench.cluster.processes import kill_tree
from embomatrix.bench.engine.workload import Workload
from embomatrix.bench.peers.contenders import (
    Contender,
    ContenderSetup,
    Done,
    Lost,
    RolloutChunk,
    StartContender,
    celery_on_redis,
    own_cluster,
    process_pool,
    ray_tasks,
)
from embomatrix.bench.peers.scene_process import executed_twice, forget_executions, write_bundles
from embomatrix.bench.report.figures import BenchError, quantile
from embomatrix.bench.report.page import CONTEST
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.wire.values import Rollout
from embomatrix.sim.process_pool import process_pool as own_processes

logger = logging.getLogger(__name__)

LEAD_GOAL: Final = 1.0
GREETINGS: Final = 4
"""Empty requests for each process at a time, until every process has answered one."""


class PeerSystem(StrEnum):
    """Libraries that could do the work of the cluster."""

    POOL = "process_pool"
    RAY = "ray"
    CELERY = "celery"


LIBRARIES: Final[Mapping[PeerSystem, tuple[StartContender, str]]] = {
    PeerSystem.POOL: (process_pool, "concurrent"),
    PeerSystem.RAY: (ray_tasks, "ray"),
    PeerSystem.CELERY: (celery_on_redis, "celery"),
}
"""Start function of each peer, and the module that must be installed for it."""


@dataclass(frozen=True, slots=True)
class PeerSizes:
    """Rollouts of each measurement."""

    peers: tuple[PeerSystem, ...] = tuple(PeerSystem)
    slots: int = 2
    chunk: int = 10
    """Rollouts of one scene in a chunk: some 25 ms of work."""
    warm: int = 10
    """Plans of each scene that are executed before the others are measured."""
    alone: int = 40
    """Rollouts with no other rollout in flight."""
    waves: int = 10
    wave: int = 8
    """Single rollouts that are submitted at once, ``waves`` times: latency under load."""
    kill_at: float = 0.25
    """Share of the results after which a process is killed."""
    limit_s: float = 45.0
    """Limit for each measurement; rollouts without a result count as hung afterwards."""
    start_s: float = 60.0
    """Limit for processes to start and load their scenes."""
    peer_s: float = 180.0
    """Limit for one peer."""


@dataclass(slots=True)
class ContestPass:
    """Outcome of chunks that were submitted at once. Latency is from the submission of all."""

    wall_s: float = 0.0
    latency_s: list[float] = field(default_factory=list)
    lost: int = 0
    hung: int = 0
    repeated: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    pids: list[int] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Results per second. Raise BenchError if there are none."""
        if not self.latency_s:
            reasons = "; ".join(self.reasons) or f"{self.hung} were never answered"
            raise BenchError(f"no rollout of the contest had a result: {reasons}")
        return len(self.latency_s) / self.wall_s


@dataclass(frozen=True, slots=True)
class PeerMeasurement:
    """Measurements of a contender. ``cpu_s`` is of all its processes and of this one."""

    all_at_once: ContestPass
    cpu_s: float
    alone_s: tuple[float, ...]
    wave_s: tuple[float, ...]
    killed: ContestPass
    repeated: int
    """Executions beyond the first of each rollout, after the kill."""


def bench_peers(workload: Workload, sizes: PeerSizes, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure our cluster and every installed peer. Raise BenchError if our cluster does not start."""
    on_step("contest: ours")
    with _folder(workload) as folder:
        setup = ContenderSetup(folder, sizes.slots, tuple(workload.bundles))
        with own_cluster(setup, workload) as contender:
            ours = _measured(contender, setup, workload, sizes)
    rate = ours.all_at_once.rate
    leads: list[Figure] = []
    figures = [*_figures("ours", ours)]
    for peer in sizes.peers:
        on_step(f"contest: {peer.value}")
        found = missing(peer) or run_apart(measure_peer, (peer, workload, sizes), sizes.peer_s)
        if isinstance(found, str):
            logger.warning("the contest goes without %s: %s", peer.value, found)
            continue
        lead = rate / found.all_at_once.rate
        leads.append(_figure(f"vs_{peer.value}", lead, "×", ours.all_at_once, LEAD_GOAL))
        figures += _figures(peer.value, found)
    return (*leads, *figures)


def missing(peer: PeerSystem) -> str:
    """Reason for leaving a peer out; empty if it can be measured here."""
    module = LIBRARIES[peer][1]
    if importlib.util.find_spec(module) is None:
        return f"{module} is not installed: `pip install 'embomatrix[bench]'`"
    return ""


def run_apart(measure: Callable[..., Any], arguments: tuple[Any, ...], limit_s: float) -> Any:
    """Return the result of a picklable call in a new process; a sentence if it fails or takes too long.

    The process and its descendants are killed at the end.
    """
    with own_processes(1) as pool:
        pid = pool.submit(os.getpid).result()
        try:
            return pool.submit(measure, *arguments).result(limit_s)
        except TimeoutError:
            return f"it was not done within {limit_s:g} s"
        except Exception as error:  # noqa: BLE001  # a library may raise anything: the contest goes without it
            return f"{type(error).__name__}: {error}"[:300]
        finally:
            kill_tree(pid)


def measure_peer(peer: PeerSystem, workload: Workload, sizes: PeerSizes) -> PeerMeasurement:
    """Measure the peer. Raises what the library raises."""
    with _folder(workload) as folder:
        setup = ContenderSetup(folder, sizes.slots, tuple(workload.bundles))
        with LIBRARIES[peer][0](setup) as contender:
            await_processes(contender, sizes.slots, sizes.start_s)
            return _measured(contender, setup, workload, sizes)


def execute(
    contender: Contender,
    chunks: Sequence[RolloutChunk],
    limit_s: float,
    on_done: Callable[[ContestPass], None] = lambda _: None,
) -> ContestPass:
    """Submit the chunks and wait for all; ``on_done`` sees the state after each result."""
    outcome = ContestPass()
    started_s = time.perf_counter()

    def take(news: Done | Lost) -> None:
        outcome.wall_s = time.perf_counter() - started_s
        if isinstance(news, Lost):
            outcome.lost += news.count
            outcome.reasons[news.reason] = outcome.reasons.get(news.reason, 0) + news.count
            return
        outcome.latency_s += [outcome.wall_s] * len(news.results)
        outcome.repeated += news.repeated
        outcome.pids.append(news.pid)
        on_done(outcome)

    contender.run(chunks, take, limit_s)
    outcome.hung = sum(map(len, chunks)) - len(outcome.latency_s) - outcome.lost
    return outcome


def await_processes(contender: Contender, count: int, limit_s: float) -> None:
    """Wait until every process has loaded its scenes. Raise BenchError if one does not."""
    deadline_s = time.monotonic() + limit_s
    seen: set[int] = set()
    while len(seen) < count:
        left_s = deadline_s - time.monotonic()
        outcome = execute(contender, [()] * (GREETINGS * count), max(0.1, left_s))
        seen.update(outcome.pids)
        if left_s <= 0 or outcome.reasons:
            reason = "; ".join(outcome.reasons) or f"{len(seen)} of {count} processes answered"
            raise BenchError(f"the peer's processes did not start within {limit_s:g} s: {reason}")


def chunks_of(rollouts: Sequence[Rollout], size: int) -> list[RolloutChunk]:
    """Chunks of one scene each."""
    by_scene: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        by_scene.setdefault(rollout.bundle_digest, []).append(rollout)
    return [
        tuple(scene[start : start + size])
        for scene in by_scene.values()
        for start in range(0, len(scene), size)
    ]


def singles(rollouts: Sequence[Rollout]) -> list[RolloutChunk]:
    """Chunks of one rollout each."""
    return [(rollout,) for rollout in rollouts]


def _measured(
    contender: Contender, setup: ContenderSetup, workload: Workload, sizes: PeerSizes
) -> PeerMeasurement:
    execute(contender, chunks_of(workload.first(sizes.warm).rollouts, sizes.chunk), sizes.limit_s)
    chunks = chunks_of(workload.after(sizes.warm).rollouts, sizes.chunk)
    before_s, own_s = descendants_cpu_s(), time.process_time()
    all_at_once = execute(contender, chunks, sizes.limit_s)
    own_s = time.process_time() - own_s
    cpu_s = own_s + descendants_cpu_s() - before_s

    def latencies(rollouts: Sequence[Rollout]) -> list[float]:
        return execute(contender, singles(rollouts), sizes.limit_s).latency_s

    alone_s = tuple(s for rollout in workload.sample(sizes.alone) for s in latencies((rollout,)))
    wave_s = tuple(s for _ in range(sizes.waves) for s in latencies(workload.sample(sizes.wave)))
    forget_executions(setup.folder)
    killed = _killed(contender, chunks, sizes)
    repeated = max(killed.repeated, executed_twice(setup.folder))
    return PeerMeasurement(all_at_once, cpu_s, alone_s, wave_s, killed, repeated)


def _killed(contender: Contender, chunks: Sequence[RolloutChunk], sizes: PeerSizes) -> ContestPass:
    """Submit everything once more and kill an executing process on the way."""
    due = sizes.kill_at * sum(map(len, chunks))
    victims: list[int] = []

    def kill(outcome: ContestPass) -> None:
        if not victims and len(outcome.latency_s) >= due:
            victims.append(contender.victim(outcome.pids))
            os.kill(victims[0], signal.SIGKILL)

    return execute(contender, chunks, sizes.limit_s, kill)


@contextlib.contextmanager
def _folder(workload: Workload) -> Iterator[Path]:
    # A killed process may still write when the folder is removed.
    with tempfile.TemporaryDirectory(prefix="embo-", ignore_cleanup_errors=True) as name:
        write_bundles(Path(name), workload.bundles)
        yield Path(name)


def _figures(system: str, found: PeerMeasurement) -> Iterator[Figure]:
    prefix, lower = f"{CONTEST}{system}: ", Better.LOWER
    everything, killed = found.all_at_once, found.killed
    count, waves = len(everything.latency_s), len(found.wave_s)
    submitted = len(killed.latency_s) + killed.lost + killed.hung
    yield _figure(f"{prefix}rollouts, 1/s", everything.rate, "1/s", everything)
    yield Figure(f"{prefix}CPU, ms", found.cpu_s / count * 1e3, "ms", lower, count)
    yield Figure(f"{prefix}alone, ms", quantile(found.alone_s, 0.5) * 1e3, "ms", lower, len(found.alone_s))
    yield Figure(f"{prefix}under load, ms", float(np.mean(found.wave_s)) * 1e3, "ms", lower, waves)
    yield Figure(f"{prefix}killed: lost", killed.lost, "count", lower, submitted)
    yield Figure(f"{prefix}killed: never answered", killed.hung, "count", lower, submitted)
    yield Figure(f"{prefix}killed: executed again", found.repeated, "count", lower, submitted)


def _figure(name: str, value: float, unit: str, measured: ContestPass, goal: float | None = None) -> Figure:
    return Figure(name, value, unit, Better.HIGHER, len(measured.latency_s), goal)
