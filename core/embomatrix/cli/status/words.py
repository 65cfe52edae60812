"""A cluster in a few sentences, for whoever asks how it does."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.values import Warmth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.rpc.values import PlanCell, RunInfo, WorkerInfo

WORKING: Final = frozenset(("ready", "suspect"))
LEFT: Final = "left"
"""In order: nobody's trouble."""
"""States in which a worker may hold rollouts that go on."""
NAMED: Final = 8
"""Workers and runs that are named; there may be thousands."""


def sentences(workers: Sequence[WorkerInfo], runs: Sequence[RunInfo], plan: Sequence[PlanCell]) -> list[str]:
    """What there is, what it does, and what stands in its way; the first sentence is the verdict."""
    return [
        _verdict(workers, runs),
        _slots(workers),
        *_runs(runs),
        *_ahead(plan),
        *_idlers(workers),
    ]


def _verdict(workers: Sequence[WorkerInfo], runs: Sequence[RunInfo]) -> str:
    waiting = sum(run.pending for run in runs)
    if all(worker.state == LEFT for worker in workers):
        return "No workers: start one with `embomatrix worker run`, here or on any machine that reaches the manager."
    if not any(worker.state in WORKING for worker in workers):
        return f"No worker works, and {waiting} rollouts wait: see below why."
    if not runs:
        return "The cluster is ready, and no run is open."
    return "The cluster works." if waiting else "The cluster is ready; its runs ask for nothing at present."


def _slots(workers: Sequence[WorkerInfo]) -> str:
    states = Counter(worker.state for worker in workers)
    told = ", ".join(f"{count} {state}" for state, count in states.most_common()) or "none"
    there = [worker for worker in workers if worker.state in WORKING]
    slots, busy = sum(worker.resources.slots for worker in there), sum(worker.running for worker in there)
    scenes = {resident.bundle_digest for worker in there for resident in worker.residents}
    return f"Workers: {told}; {busy} of {slots} slots run a rollout; {len(scenes)} scenes are in memory."


def _runs(runs: Sequence[RunInfo]) -> list[str]:
    told: list[str] = []
    for run in runs[-NAMED:]:
        stats = run.stats
        started = stats.warm_starts + stats.cold_starts
        warm = f", {stats.warm_starts / started:.0%} of them in warm scenes" if started else ""
        failed = (
            f"; {stats.infra_failures} lost by the infrastructure" if stats.infra_failures else "; none lost"
        )
        again = f", {stats.redispatched} given again" if stats.redispatched else ""
        told.append(
            f"Run {run.name or run.run_id}: {stats.delivered} rollouts done{warm}{failed}{again}; {run.pending} under way."
        )
    more = len(runs) - NAMED
    return [*told, f"{more} more runs are open."] if more > 0 else told


def _ahead(plan: Sequence[PlanCell]) -> list[str]:
    if not plan:
        return []
    counts = Counter(cell.warmth for cell in plan)
    steps = {(cell.run_id, cell.step) for cell in plan}
    told = [f"{counts[Warmth.WARM]} of {len(plan)} scenes of the next {len(steps)} steps are warm"]
    if counts[Warmth.UNPLACEABLE]:
        told.append(f"{counts[Warmth.UNPLACEABLE]} find no room: give workers memory, or start more")
    return [f"Look-ahead: {'; '.join(told)}."]


def _idlers(workers: Sequence[WorkerInfo]) -> list[str]:
    """Who doesn't work, and why."""
    idle = [worker for worker in workers if worker.state not in ("ready", LEFT)]
    told = [
        f"{worker.worker_id} is {worker.state}{f': {worker.reason}' if worker.reason else ''}."
        for worker in idle[:NAMED]
    ]
    more = len(idle) - NAMED
    return [*told, f"{more} more don't work: see `embomatrix cluster workers`."] if more > 0 else told
