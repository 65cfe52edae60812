"""A cluster in a few sentences, for whoever asks how it does."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.values import Warmth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.rpc.wire.values import FleetStatus, PlanCell, RunInfo, WorkerInfo

WORKING: Final = frozenset(("ready", "suspect"))
"""States in which a worker may hold rollouts that go on."""
LEFT: Final = "left"
"""In order: nobody's trouble."""
NAMED: Final = 8
"""Workers and runs that are named; there may be thousands."""


def sentences(fleet: FleetStatus, runs: Sequence[RunInfo], plan: Sequence[PlanCell]) -> list[str]:
    """What there is, what it does, and what stands in its way.

    The first sentence is the verdict: the manager's own, which knows more than can be seen from here, as a full disk.
    """
    return [
        fleet.health or _verdict(fleet.workers, runs),
        *_help(fleet.workers),
        _slots(fleet.workers),
        *_runs(runs),
        *_ahead(plan),
        *_idlers(fleet.workers),
    ]


def _verdict(workers: Sequence[WorkerInfo], runs: Sequence[RunInfo]) -> str:
    """Of what can be seen, where the manager is of a release that says nothing."""
    if _deserted(workers):
        return "No worker is there."
    waiting = sum(run.pending for run in runs)
    if not any(worker.state in WORKING for worker in workers):
        return f"No worker works, and {counted(waiting, 'rollout')} wait: see below why."
    if not runs:
        return "The cluster is ready, and no run is open."
    return "The cluster works." if waiting else "The cluster is ready; its runs ask for nothing at present."


def _help(workers: Sequence[WorkerInfo]) -> list[str]:
    """What to do where nobody works."""
    if not _deserted(workers):
        return []
    return ["Start a worker with `embomatrix worker run`, here or on any machine that reaches the manager."]


def _deserted(workers: Sequence[WorkerInfo]) -> bool:
    return all(worker.state == LEFT for worker in workers)


def counted(number: int, thing: str) -> str:
    """One thing, or several things."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _slots(workers: Sequence[WorkerInfo]) -> str:
    states = Counter(worker.state for worker in workers)
    told = ", ".join(f"{count} {state}" for state, count in states.most_common()) or "none"
    there = [worker for worker in workers if worker.state in WORKING]
    slots, busy = sum(worker.resources.slots for worker in there), sum(worker.running for worker in there)
    scenes = {resident.bundle_digest for worker in there for resident in worker.residents}
    memory = f"{counted(len(scenes), 'scene')} {'is' if len(scenes) == 1 else 'are'} in memory"
    return f"Workers: {told}; {busy} of {counted(slots, 'slot')} busy; {memory}."


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
        done = f"{counted(stats.delivered, 'rollout')} done{warm}{failed}{again}"
        told.append(f"Run {run.name or run.run_id}: {done}; {run.pending} under way.")
    more = len(runs) - NAMED
    return [*told, f"{more} more runs are open."] if more > 0 else told


def _ahead(plan: Sequence[PlanCell]) -> list[str]:
    if not plan:
        return []
    counts = Counter(cell.warmth for cell in plan)
    steps = {(cell.run_id, cell.step) for cell in plan}
    ahead = "the next step" if len(steps) == 1 else f"the next {len(steps)} steps"
    told = [f"{counts[Warmth.WARM]} of {counted(len(plan), 'scene')} of {ahead} warm"]
    if counts[Warmth.UNPLACEABLE]:
        told.append(f"{counts[Warmth.UNPLACEABLE]} without room: give workers memory, or start more")
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
