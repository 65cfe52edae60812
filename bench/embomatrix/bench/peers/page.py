"""The contest in figures, and as a table for the page of benchmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.peers.contest import PeerSystem
from embomatrix.bench.report.figures import quantile
from embomatrix.pages.figures import Better, Figure, shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from embomatrix.bench.peers.contender import Pass
    from embomatrix.bench.peers.contest import Contest, PeerOutcome, Tuned

OURS: Final = "ours"
PREFIX: Final = "contest, "
"""How the names begin of figures that the contest's table shows."""
LEAD_GOAL: Final = 1.0
CONTEST: Final = (
    "Ours, a manager and a worker with two slots, driven over gRPC, against libraries that execute the same plans of "
    "the pinned workload with the same simulator in two processes of their own. *Plain*: a call for each rollout, "
    "which loads its scene. *Shared*: two processes that have loaded every scene take chunks of ten rollouts of a "
    "scene from one queue (`ProcessPoolExecutor`; Ray tasks; a Celery worker of two prefork processes, on a real "
    "redis-server, with `acks_late` and `reject_on_worker_lost`). *Affine*: a queue for each process, and all of a "
    "scene's rollouts in one (an executor each; Ray actors with `max_restarts=-1` and `max_task_retries=-1`; a Celery "
    "worker each). *New scenes* is affine with nothing loaded: none of them knows what comes next, so each scene's "
    "first rollout waits until it is loaded. Plans and results travel as the bytes that our slots take; heaps are "
    "frozen as in our slots. Ours and *shared* have executed ten plans of each scene before; no plan is executed "
    "twice before throughput is measured. *Alone* is one rollout with nothing else under way, *under load* the mean "
    "of eight that are submitted at once, each for itself. *Killed*: everything at once, and a process that executes "
    "gets SIGKILL after a quarter of the results. Ours keeps every rollout and its lease in SQLite and checks what "
    "comes over the wire. The pool does neither, and when one of its processes dies, it gives up all that it has and "
    "must be made anew. `pip install 'embomatrix[bench]'` brings the libraries. *Ours over it* is against the faster "
    "of shared and affine."
)


def contest_figures(contest: Contest) -> tuple[Figure, ...]:
    """Everything that was measured, and our throughput over that of each peer as it is tuned best."""
    ours = contest.ours
    rate = ours.all_at_once.rate
    return (
        *(
            _figure(f"vs_{peer.value}", rate / found.best_rate, "×", ours.all_at_once, LEAD_GOAL)
            for peer, found in contest.peers.items()
        ),
        _figure(_name(OURS, "rollouts, shared"), rate, "1/s", ours.all_at_once),
        *_tuned(OURS, ours),
        *(figure for peer, found in contest.peers.items() for figure in _peer(peer.value, found)),
    )


def _peer(who: str, found: PeerOutcome) -> Iterator[Figure]:
    yield _figure(_name(who, "rollouts, plain"), found.plain.rate, "1/s", found.plain)
    yield _figure(
        _name(who, "rollouts, shared"), found.shared.all_at_once.rate, "1/s", found.shared.all_at_once
    )
    yield _figure(_name(who, "rollouts, affine"), found.affine.rate, "1/s", found.affine)
    yield _figure(
        _name(who, "rollouts, affine, new scenes"), found.affine_cold.rate, "1/s", found.affine_cold
    )
    yield _count(_name(who, "scenes that rollouts waited for"), found.affine_cold.loads, found.affine_cold)
    yield from _tuned(who, found.shared)


def _tuned(who: str, found: Tuned) -> Iterator[Figure]:
    waves_s = [seconds for wave in found.waves for seconds in wave.latency_s]
    killed = found.killed
    count = len(found.all_at_once.latency_s)
    yield Figure(_name(who, "CPU of a rollout"), found.cpu_s / count * 1e3, "ms", Better.LOWER, count)
    alone_ms = quantile(found.alone.latency_s, 0.5) * 1e3
    yield Figure(_name(who, "alone, p50"), alone_ms, "ms", Better.LOWER, len(found.alone.latency_s))
    yield Figure(
        _name(who, "under load, mean"), float(np.mean(waves_s)) * 1e3, "ms", Better.LOWER, len(waves_s)
    )
    yield Figure(
        _name(who, "under load, p95"), quantile(waves_s, 0.95) * 1e3, "ms", Better.LOWER, len(waves_s)
    )
    if who == OURS:
        yield _count(
            _name(who, "scenes that rollouts waited for"), found.all_at_once.loads, found.all_at_once
        )
    yield _count(_name(who, "killed: lost"), killed.lost, killed)
    yield _count(_name(who, "killed: never heard of"), killed.hung, killed)
    yield _count(_name(who, "killed: executed again"), found.repeated, killed)


def _figure(name: str, value: float, unit: str, measured: Pass, goal: float | None = None) -> Figure:
    return Figure(name, value, unit, Better.HIGHER, len(measured.latency_s), goal)


def _count(name: str, value: int, measured: Pass) -> Figure:
    submitted = len(measured.latency_s) + measured.lost + measured.hung
    return Figure(name, float(value), "count", Better.LOWER, submitted)


def _name(who: str, what: str) -> str:
    return f"{PREFIX}{who}: {what}"


COLUMNS: Final[Mapping[str, str]] = {
    "plain, 1/s": "rollouts, plain",
    "shared, 1/s": "rollouts, shared",
    "affine, 1/s": "rollouts, affine",
    "new scenes, 1/s": "rollouts, affine, new scenes",
    "CPU, ms": "CPU of a rollout",
    "scenes waited for": "scenes that rollouts waited for",
    "alone, ms": "alone, p50",
    "under load, ms": "under load, mean",
    "killed: lost": "killed: lost",
    "never heard of": "killed: never heard of",
    "executed again": "killed: executed again",
}
"""Headings of the table, and the figures below them."""


def contest_lines(figures: Sequence[Figure]) -> list[str]:
    """The table in Markdown; nothing when no contest was held."""
    values = {figure.name: figure.value for figure in figures}
    if _name(OURS, "rollouts, shared") not in values:
        return []
    lines = [
        f"| | {' | '.join(COLUMNS)} | ours over it |",
        f"| --- | {' | '.join(['---:'] * len(COLUMNS))} | ---: |",
    ]
    for who in (OURS, *PeerSystem):
        measured = who == OURS or f"vs_{who}" in values
        cells = [_cell(values, _name(who, what)) for what in COLUMNS.values()]
        lead = _cell(values, f"vs_{who}") if measured else "not measured"
        lines.append(f"| {who.replace('_', ' ')} | {' | '.join(cells)} | {lead} |")
    return lines


def _cell(values: Mapping[str, float], name: str) -> str:
    return shown(values[name]) if name in values else ""
