"""Our cluster against what one would pick instead, on the same engine, the same plans and the same cores, in one run.

Each peer runs as its tutorial shows and tuned in two ways: see ``LibraryMode``. Tuned, its processes hold the scenes
and
have loaded them before the clock starts. No plan is executed twice in a process before throughput has been measured.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import logging
import os
import signal
import tempfile
import time
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.cpu import descendants_cpu_s
from embomatrix.bench.engine.apart import apart
from embomatrix.bench.peers.contender import ContenderSetup, LibraryMode, Pass, RolloutChunk, execute, greet
from embomatrix.bench.peers.engine_pool import executed_twice, forget_executions, write_bundles
from embomatrix.bench.peers.own_cluster import own_cluster

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from embomatrix.bench.cluster.work import ClusterWorkload
    from embomatrix.bench.peers.contender import Bring, Contender
    from embomatrix.rpc.wire.values import Rollout


logger = logging.getLogger(__name__)


class PeerSystem(StrEnum):
    """What one would pick instead."""

    POOL = "process_pool"
    RAY = "ray"
    CELERY = "celery"


@dataclass(frozen=True, slots=True)
class Library:
    """Where a peer's adapter is, and what must be installed for it."""

    module: str
    function: str
    needs: str


LIBRARIES: Final[Mapping[PeerSystem, Library]] = {
    PeerSystem.POOL: Library("embomatrix.bench.peers.process_pool", "process_pool", "concurrent"),
    PeerSystem.RAY: Library("embomatrix.bench.peers.ray_peer", "ray_cluster", "ray"),
    PeerSystem.CELERY: Library("embomatrix.bench.peers.celery_peer", "celery_on_redis", "celery"),
}


@dataclass(frozen=True, slots=True)
class PeerSizes:
    """Rollouts of each measurement."""

    peers: tuple[PeerSystem, ...] = tuple(PeerSystem)
    slots: int = 2
    chunk: int = 10
    """Rollouts of one scene that are sent together when a peer is tuned: some 25 ms of work."""
    warm: int = 10
    """Plans of each scene that the tuned processes execute before the others are measured: they have worked before."""
    plain: int = 40
    alone: int = 40
    """Rollouts with nothing else under way."""
    waves: int = 10
    wave: int = 8
    """So many times so many rollouts are submitted at once, each for itself: latency under load."""
    kill_at: float = 0.25
    """Share of the results after which a process is killed."""
    limit_s: float = 45.0
    """For each measurement: what was not heard of by then is counted as hung."""
    start_s: float = 60.0
    """For processes to start and to load their scenes."""
    peer_s: float = 180.0
    """For all of one peer, which is given up then."""


@dataclass(frozen=True, slots=True)
class Tuned:
    """What was measured of one contender that holds its scenes."""

    all_at_once: Pass
    cpu_s: float
    """Processor time of all its processes meanwhile, and of the one that submits."""
    alone: Pass
    waves: tuple[Pass, ...]
    killed: Pass
    repeated: int
    """Executions beyond the first of each rollout, after the kill."""


@dataclass(frozen=True, slots=True)
class PeerOutcome:
    """What was measured of one peer."""

    plain: Pass
    shared: Tuned
    affine_cold: Pass
    """Half of the plans in scenes that nobody loaded before: what a step with new scenes costs without look-ahead."""
    affine: Pass
    """The other half, now that the scenes are there."""

    @property
    def best_rate(self) -> float:
        """Results per second of the better of both ways to tune it."""
        return max(self.shared.all_at_once.rate, self.affine.rate)


@dataclass(frozen=True, slots=True)
class Contest:
    """Ours, the peers that could be measured, and why the others could not."""

    ours: Tuned
    peers: Mapping[PeerSystem, PeerOutcome] = field(default_factory=dict)
    skipped: Mapping[PeerSystem, str] = field(default_factory=dict)


def hold_contest(work: ClusterWorkload, sizes: PeerSizes, on_step: Callable[[str], None]) -> Contest:
    """Measure ours and every peer that is installed. Raises BenchError when a contender does not come up."""
    on_step("the contest: ours")
    with _folder(work) as folder:
        setup = ContenderSetup(LibraryMode.SHARED, folder, sizes.slots, tuple(work.bundles))
        with own_cluster(setup, work) as contender:
            ours = _tuned(contender, setup, work, sizes)
    peers: dict[PeerSystem, PeerOutcome] = {}
    skipped: dict[PeerSystem, str] = {}
    for peer in sizes.peers:
        on_step(f"the contest: {peer.value}")
        outcome = missing(peer) or apart(measure_peer, (peer, work, sizes), sizes.peer_s)
        if isinstance(outcome, PeerOutcome):
            peers[peer] = outcome
        else:
            skipped[peer] = str(outcome)
            logger.warning("the contest goes without %s: %s", peer.value, outcome)
    return Contest(ours, peers, skipped)


def missing(peer: PeerSystem) -> str:
    """Why a peer can't be measured here; "" when it can."""
    needs = LIBRARIES[peer].needs
    if importlib.util.find_spec(needs) is None:
        return f"{needs} is not installed: `pip install 'embomatrix[bench]'`"
    return ""


def measure_peer(peer: PeerSystem, work: ClusterWorkload, sizes: PeerSizes) -> PeerOutcome:
    """Bring the peer up in each mode and measure it. Raises what the library raises."""
    library = LIBRARIES[peer]
    bring: Bring = getattr(importlib.import_module(library.module), library.function)
    with _brought(bring, LibraryMode.PLAIN, work, sizes) as (contender, _):
        # The first calls start the processes.
        execute(contender, singles(work.sample(2 * sizes.slots)), sizes.limit_s)
        plain = execute(contender, singles(work.sample(sizes.plain)), sizes.limit_s)
    with _brought(bring, LibraryMode.SHARED, work, sizes, preload=tuple(work.bundles)) as (contender, setup):
        greet(contender, setup, sizes.start_s)
        shared = _tuned(contender, setup, work, sizes)
    with _brought(bring, LibraryMode.AFFINE, work, sizes) as (contender, setup):
        greet(contender, setup, sizes.start_s)
        first, second = (
            chunks_of(part, sizes.chunk, setup.lanes) for part in (work.rollouts[0::2], work.rollouts[1::2])
        )
        cold = execute(contender, first, sizes.limit_s)
        affine = execute(contender, second, sizes.limit_s)
    return PeerOutcome(plain, shared, cold, affine)


def _tuned(contender: Contender, setup: ContenderSetup, work: ClusterWorkload, sizes: PeerSizes) -> Tuned:
    execute(contender, chunks_of(work.first(sizes.warm).rollouts, sizes.chunk, setup.lanes), sizes.limit_s)
    chunks = chunks_of(work.after(sizes.warm).rollouts, sizes.chunk, setup.lanes)
    before_s, own_s = descendants_cpu_s(), time.process_time()
    all_at_once = execute(contender, chunks, sizes.limit_s)
    own_s = time.process_time() - own_s
    cpu_s = own_s + descendants_cpu_s() - before_s
    alone = Pass()
    for rollout in work.sample(sizes.alone):
        alone.latency_s += execute(contender, singles((rollout,)), sizes.limit_s).latency_s
    sample = work.sample(sizes.wave)
    waves = tuple(execute(contender, singles(sample), sizes.limit_s) for _ in range(sizes.waves))
    forget_executions(setup.folder)
    killed = _killed(contender, chunks, sizes)
    repeated = max(killed.repeated, executed_twice(setup.folder))
    return Tuned(all_at_once, cpu_s, alone, waves, killed, repeated)


def _killed(contender: Contender, chunks: Sequence[RolloutChunk], sizes: PeerSizes) -> Pass:
    """Once more everything at once; a process that executes is killed in the middle."""
    due = sizes.kill_at * sum(len(chunk.rollouts) for chunk in chunks)
    victims: list[int] = []

    def kill(outcome: Pass) -> None:
        if not victims and len(outcome.latency_s) >= due:
            victims.append(contender.victim(outcome.pids))
            os.kill(victims[0], signal.SIGKILL)

    return execute(contender, chunks, sizes.limit_s, kill)


def chunks_of(rollouts: Sequence[Rollout], size: int, lanes: int) -> list[RolloutChunk]:
    """Chunks of one scene each. The scenes are shared out over the lanes, and the lanes' chunks take turns."""
    by_scene: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        by_scene.setdefault(rollout.bundle_digest, []).append(rollout)
    queues: list[list[RolloutChunk]] = [[] for _ in range(lanes)]
    for number, scene in enumerate(by_scene.values()):
        lane = number % lanes
        queues[lane] += [
            RolloutChunk(lane, tuple(scene[start : start + size])) for start in range(0, len(scene), size)
        ]
    longest = max(map(len, queues), default=0)
    return [queue[turn] for turn in range(longest) for queue in queues if turn < len(queue)]


def singles(rollouts: Sequence[Rollout]) -> list[RolloutChunk]:
    """Every rollout for itself, in the first queue."""
    return [RolloutChunk(0, (rollout,)) for rollout in rollouts]


@contextlib.contextmanager
def _brought(
    bring: Bring, mode: LibraryMode, work: ClusterWorkload, sizes: PeerSizes, preload: tuple[str, ...] = ()
) -> Iterator[tuple[Contender, ContenderSetup]]:
    """A contender in a folder of its own with the bundles."""
    with _folder(work) as folder:
        setup = ContenderSetup(mode, folder, sizes.slots, preload)
        with bring(setup) as contender:
            yield contender, setup


@contextlib.contextmanager
def _folder(work: ClusterWorkload) -> Iterator[Path]:
    # What is killed may still write when the folder is removed.
    with tempfile.TemporaryDirectory(prefix="embo-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        write_bundles(folder, work.bundles)
        yield folder
