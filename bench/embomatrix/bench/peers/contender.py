"""What executes rollouts in a contest: our cluster, or what one would pick instead, all behind one protocol."""

from __future__ import annotations

import concurrent.futures
import time
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Protocol

from embomatrix.bench.report.figures import BenchError
from embomatrix.proto.v1 import types_pb2
from embomatrix.rpc.wire.outcome import completed_from_proto
from embomatrix.rpc.wire.rollout import rollout_to_proto

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Future
    from contextlib import AbstractContextManager
    from pathlib import Path

    from embomatrix.bench.peers.engine_pool import Answer
    from embomatrix.rpc.wire.values import Completed, Rollout

    Take = Callable[["Done | Lost"], None]
    Bring = Callable[["ContenderSetup"], AbstractContextManager["Contender"]]

GREETINGS: Final = 4
"""Requests for each process at a time, until all have answered one."""


class LibraryMode(StrEnum):
    """How a library is used."""

    PLAIN = "plain"
    """One call for each rollout, which loads its scene: what its tutorial shows."""
    SHARED = "shared"
    """Processes that hold scenes take chunks of rollouts from one queue."""
    AFFINE = "affine"
    """The same with a queue for each process: all rollouts of a scene go to one of them."""


@dataclass(frozen=True, slots=True)
class ContenderSetup:
    """What a contender is brought up for."""

    mode: LibraryMode
    folder: Path
    """Where the bundles lie, and where processes may write."""
    slots: int
    """Processes that execute."""
    preload: tuple[str, ...] = ()
    """Bundles that every process loads before it executes anything."""

    @property
    def lanes(self) -> int:
        """Queues."""
        return self.slots if self.mode is LibraryMode.AFFINE else 1

    @property
    def processes_each(self) -> int:
        """Processes of each queue."""
        return self.slots // self.lanes


@dataclass(frozen=True, slots=True)
class RolloutChunk:
    """Rollouts that are sent together, and the queue that they are sent to."""

    lane: int
    rollouts: tuple[Rollout, ...]

    @property
    def requests(self) -> list[bytes]:
        """The rollouts as bytes."""
        return [rollout_to_proto(rollout).SerializeToString() for rollout in self.rollouts]


@dataclass(frozen=True, slots=True)
class Done:
    """Results of a chunk, or of a part of it, from one process."""

    pid: int
    loads: int
    """Scenes that were loaded while these rollouts waited."""
    results: tuple[Completed, ...]
    repeated: int = 0
    """Executions beyond the first, where the contender itself tells."""


@dataclass(frozen=True, slots=True)
class Lost:
    """The library gave the chunk up."""

    count: int
    reason: str


class Contender(Protocol):
    """Executes chunks in processes that it has started."""

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        """Submit all at once and tell what becomes of each as soon as it is known; return when all is known.

        After ``limit_s`` seconds it returns with what it has.
        """

    def victim(self, pids: Sequence[int]) -> int:
        """A process that executes now, to be killed. ``pids`` answered already."""


@dataclass(slots=True)
class Pass:
    """What came of chunks that were submitted at once."""

    wall_s: float = 0.0
    latency_s: list[float] = field(default_factory=list)
    """Of each rollout that has a result, from the submission of all."""
    loads: int = 0
    lost: int = 0
    hung: int = 0
    """Rollouts of which nothing was heard in time."""
    repeated: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    pids: list[int] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Results per second. Raises BenchError when there are none."""
        if not self.latency_s:
            told = "; ".join(self.reasons) or f"{self.hung} were never heard of"
            raise BenchError(f"not one rollout of the contest had a result: {told}")
        return len(self.latency_s) / self.wall_s


def execute(
    contender: Contender,
    chunks: Sequence[RolloutChunk],
    limit_s: float,
    on_done: Callable[[Pass], None] = lambda _: None,
) -> Pass:
    """Submit the chunks and wait for all. ``on_done`` sees what has come so far after each result."""
    outcome = Pass()
    started_s = time.perf_counter()

    def take(news: Done | Lost) -> None:
        outcome.wall_s = time.perf_counter() - started_s
        if isinstance(news, Lost):
            outcome.lost += news.count
            outcome.reasons[news.reason] = outcome.reasons.get(news.reason, 0) + news.count
            return
        outcome.latency_s += [outcome.wall_s] * len(news.results)
        outcome.loads += news.loads
        outcome.repeated += news.repeated
        outcome.pids.append(news.pid)
        on_done(outcome)

    contender.run(chunks, take, limit_s)
    submitted = sum(len(chunk.rollouts) for chunk in chunks)
    outcome.hung = submitted - len(outcome.latency_s) - outcome.lost
    return outcome


def greet(contender: Contender, setup: ContenderSetup, limit_s: float) -> None:
    """Wait until every process has started and loaded what it should. Raises BenchError when one does not."""
    deadline_s = time.monotonic() + limit_s
    seen: set[int] = set()
    while len(seen) < setup.slots:
        left_s = deadline_s - time.monotonic()
        greetings = [RolloutChunk(lane, ()) for lane in range(setup.lanes)] * (
            GREETINGS * setup.processes_each
        )
        outcome = execute(contender, greetings, max(0.1, left_s))
        seen.update(outcome.pids)
        if left_s <= 0 or outcome.reasons:
            told = "; ".join(outcome.reasons) or f"{len(seen)} of {setup.slots} processes answered"
            raise BenchError(f"the peer's processes did not start within {limit_s:g} s: {told}")


def done_from(answer: Answer | bytes) -> Done:
    """What a process answered, with the results as values: a trainer needs them so. Bytes are one plain call's result."""
    pid, loads, results = (0, 1, [answer]) if isinstance(answer, bytes) else answer
    return Done(
        pid, loads, tuple(completed_from_proto(types_pb2.Completed.FromString(data)) for data in results)
    )


def follow(
    futures: Mapping[Future[Any], RolloutChunk],
    take: Take,
    limit_s: float,
) -> None:
    """Tell what becomes of futures as they are done."""
    try:
        for future in concurrent.futures.as_completed(futures, timeout=limit_s):
            error = future.exception()
            if error is not None:
                take(Lost(len(futures[future].rollouts), type(error).__name__))
                continue
            take(done_from(future.result()))
    except TimeoutError:
        return
