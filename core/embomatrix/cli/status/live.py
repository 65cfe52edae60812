"""`embomatrix top`: the cluster as one screen that is drawn anew every second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rich.console import Group
from rich.text import Text

from embomatrix.cli.cluster.tables import run_table, worker_table
from embomatrix.cli.status.words import WORKING, counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from embomatrix.rpc.wire.values import FleetStatus, RunInfo, WorkerInfo

OTHER_LINES: Final = 7
"""Lines that are no run's and no worker's: two of the head, two empty ones, the heads of two tables, how many more."""


@dataclass(frozen=True, slots=True)
class Glance:
    """The cluster at one moment. ``at_s`` is on a clock that only goes forward."""

    at_s: float
    fleet: FleetStatus
    runs: tuple[RunInfo, ...]

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        return self.fleet.workers

    @property
    def completed(self) -> int:
        """Of all workers that are known."""
        return sum(worker.completed for worker in self.workers)


def rate(before: Glance, now: Glance) -> float:
    """Completed rollouts per second between two moments. A worker that was forgotten meanwhile counts for nothing."""
    gone_s = now.at_s - before.at_s
    return max(0.0, now.completed - before.completed) / gone_s if gone_s > 0 else 0.0


def screen(before: Glance, now: Glance, *, lines: int) -> RenderableType:
    """What fits in so many lines: the runs, and of the workers the busiest, after those that don't work."""
    there = [worker for worker in now.workers if worker.state in WORKING]
    slots, busy = sum(worker.resources.slots for worker in there), sum(worker.running for worker in there)
    head = Text(f"{rate(before, now):,.0f} rollouts/s", style="bold")
    head.append(
        f"   {busy} of {counted(slots, 'slot')} busy   {len(there)} of {counted(len(now.workers), 'worker')} at work"
        f"   {counted(len(now.runs), 'run')}",
        style="default",
    )
    if now.fleet.health:
        head.append(f"\n{now.fleet.health}", style="default")
    runs = now.runs[-max(1, lines // 3) :]
    room = max(1, lines - OTHER_LINES - len(runs))
    shown = sorted(now.workers, key=_order)[:room]
    more = len(now.workers) - len(shown)
    parts: list[RenderableType] = [head, Text("")]
    parts += [run_table(runs), Text("")] if runs else [Text("no open runs", style="dim"), Text("")]
    parts.append(worker_table(shown) if shown else Text("no workers", style="dim"))
    if more > 0:
        parts.append(Text(f"and {more} more", style="dim"))
    return Group(*parts)


def _order(worker: WorkerInfo) -> tuple[bool, int, str]:
    return (worker.state == "ready", -worker.running, worker.worker_id)


def earliest(glances: Sequence[Glance], span_s: float) -> Glance:
    """Of those that are at most so long before the last: rates over one second jump."""
    last = glances[-1]
    return next(glance for glance in glances if last.at_s - glance.at_s <= span_s)
