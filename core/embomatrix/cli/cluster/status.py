"""`embomatrix status` and `embomatrix top`: the state of a cluster, in sentences and live."""

import asyncio
import contextlib
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from embomatrix.cli.cluster.tables import run_table, show_json, worker_table
from embomatrix.cli.connection import AsJson, manager_command
from embomatrix.host.printable import printable
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.status import UnavailableError
from embomatrix.rpc.wire.values import FleetStatus, PlanCell, RunInfo, Warmth, WorkerInfo

REFRESH_S: Final = 1.0
RATE_S: Final = 5.0
"""Time span of the throughput: rates over one second fluctuate."""
TIMEOUT_S: Final = 2.0
"""Longest wait for a manager that is away."""
WORKING: Final = frozenset(("ready", "suspect"))
"""States in which a worker may hold running rollouts."""
LEFT: Final = "left"
NAMED: Final = 8
"""Most workers and runs that sentences name."""
OTHER_LINES: Final = 7
"""Lines of the screen beside runs and workers: header, blank lines, table heads, remainder."""


@manager_command("status", timeout_s=TIMEOUT_S)
async def status(client: AdminClient, as_json: AsJson = False) -> None:
    """Describe the cluster in a few sentences: workers, runs, warm scenes, and workers that do not work."""
    fleet, runs, plan = await asyncio.gather(client.fleet(), client.list_runs(), client.plan())
    described = sentences(fleet, runs, plan)
    if as_json:
        show_json({"sentences": described, "workers": fleet.workers, "runs": runs, "plan": plan})
        return
    console = Console(highlight=False)
    for sentence in described:
        console.print(printable(sentence), markup=False)


@manager_command("top", timeout_s=TIMEOUT_S, until_interrupted=True)
async def top(
    client: AdminClient,
    rounds: Annotated[int, typer.Option(help="Stop after this many refreshes; 0: at Ctrl-C.", min=0)] = 0,
) -> None:
    """Watch the cluster live: throughput, runs and workers, those that do not work first."""
    console = Console(highlight=False)
    glances: deque[Glance] = deque(maxlen=int(RATE_S / REFRESH_S) + 1)
    shown = 0
    glances.append(await _look(client))
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        while True:
            live.update(screen(earliest(glances, RATE_S), glances[-1], lines=console.height), refresh=True)
            shown += 1
            if shown == rounds:
                return
            await asyncio.sleep(REFRESH_S)
            # The manager may restart meanwhile.
            with contextlib.suppress(UnavailableError):
                glances.append(await _look(client))


@dataclass(frozen=True, slots=True)
class Glance:
    """The cluster at one moment of a monotonic clock."""

    at_s: float
    fleet: FleetStatus
    runs: tuple[RunInfo, ...]

    @property
    def completed(self) -> int:
        return sum(worker.completed for worker in self.fleet.workers)


def earliest(glances: Sequence[Glance], span_s: float) -> Glance:
    """Return the first glance within ``span_s`` seconds before the last."""
    return next(glance for glance in glances if glances[-1].at_s - glance.at_s <= span_s)


def rate(before: Glance, now: Glance) -> float:
    """Return completed rollouts per second between two glances, at least 0: workers may be forgotten meanwhile."""
    gone_s = now.at_s - before.at_s
    return max(0.0, now.completed - before.completed) / gone_s if gone_s > 0 else 0.0


def screen(before: Glance, now: Glance, *, lines: int) -> RenderableType:
    """Draw runs and workers within ``lines`` lines; workers that do not work come first, then the busiest."""
    present, busy = _at_work(now.fleet.workers)
    head = Text(f"{rate(before, now):,.0f} rollouts/s", style="bold")
    head.append(
        f"   {busy}   {len(present)} of {counted(len(now.fleet.workers), 'worker')} at work"
        f"   {counted(len(now.runs), 'run')}",
        style="default",
    )
    if now.fleet.health:
        head.append(f"\n{printable(now.fleet.health)}", style="default")
    runs = now.runs[-max(1, lines // 3) :]
    room = max(1, lines - OTHER_LINES - len(runs))
    order = sorted(now.fleet.workers, key=lambda w: (w.state == "ready", -w.running, w.worker_id))
    more = len(order) - room
    parts: list[RenderableType] = [head, Text("")]
    parts += [run_table(runs) if runs else Text("no open runs", style="dim"), Text("")]
    parts.append(worker_table(order[:room]) if order else Text("no workers", style="dim"))
    if more > 0:
        parts.append(Text(f"and {more} more", style="dim"))
    return Group(*parts)


def sentences(fleet: FleetStatus, runs: Sequence[RunInfo], plan: Sequence[PlanCell]) -> list[str]:
    """Describe the cluster. The first sentence is the manager's own verdict, as the dashboard shows it."""
    lines = [fleet.health]
    if all(worker.state == LEFT for worker in fleet.workers):
        lines.append(
            "Start a worker with `embomatrix worker run`, here or on any machine that reaches the manager."
        )
    return [*lines, _slots(fleet.workers), *_runs(runs), *_ahead(plan), *_idle_workers(fleet.workers)]


def counted(number: int, noun: str) -> str:
    """Return the number with the noun in singular or plural."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


async def _look(client: AdminClient) -> Glance:
    fleet, runs = await asyncio.gather(client.fleet(), client.list_runs())
    return Glance(time.monotonic(), fleet, runs)


def _at_work(workers: Sequence[WorkerInfo]) -> tuple[list[WorkerInfo], str]:
    """Return the workers at work, and the number of their busy slots in words."""
    present = [worker for worker in workers if worker.state in WORKING]
    slots, busy = sum(worker.resources.slots for worker in present), sum(worker.running for worker in present)
    return present, f"{busy} of {counted(slots, 'slot')} busy"


def _slots(workers: Sequence[WorkerInfo]) -> str:
    states = Counter(worker.state for worker in workers)
    counts = ", ".join(f"{count} {state}" for state, count in states.most_common()) or "none"
    present, busy = _at_work(workers)
    scenes = {resident.bundle_digest for worker in present for resident in worker.residents}
    memory = f"{counted(len(scenes), 'scene')} {'is' if len(scenes) == 1 else 'are'} in memory"
    return f"Workers: {counts}; {busy}; {memory}."


def _runs(runs: Sequence[RunInfo]) -> list[str]:
    lines: list[str] = []
    for run in runs[-NAMED:]:
        stats = run.stats
        started = stats.warm_starts + stats.cold_starts
        warm = f", {stats.warm_starts / started:.0%} of them in warm scenes" if started else ""
        shared = f", {stats.shared_share:.0%} of their steps shared" if stats.shared_steps else ""
        failed = (
            f"; {stats.infra_failures} lost by the infrastructure" if stats.infra_failures else "; none lost"
        )
        again = f", {stats.redispatched} re-dispatched" if stats.redispatched else ""
        done = f"{counted(stats.delivered, 'rollout')} done{warm}{shared}{failed}{again}"
        lines.append(f"Run {run.name or run.run_id}: {done}; {run.pending} under way.")
    more = len(runs) - NAMED
    return [*lines, f"{more} more runs are open."] if more > 0 else lines


def _ahead(plan: Sequence[PlanCell]) -> list[str]:
    if not plan:
        return []
    counts = Counter(cell.warmth for cell in plan)
    steps = {(cell.run_id, cell.step) for cell in plan}
    ahead = "the next step" if len(steps) == 1 else f"the next {len(steps)} steps"
    parts = [f"{counts[Warmth.WARM]} of {counted(len(plan), 'scene')} of {ahead} warm"]
    if counts[Warmth.UNPLACEABLE]:
        parts.append(f"{counts[Warmth.UNPLACEABLE]} without room: give workers memory, or start more")
    return [f"Look-ahead: {'; '.join(parts)}."]


def _idle_workers(workers: Sequence[WorkerInfo]) -> list[str]:
    """Return a sentence for each worker that does not work, with the reason."""
    idle = [worker for worker in workers if worker.state not in ("ready", LEFT)]
    lines = [
        f"{worker.worker_id} is {worker.state}{f': {worker.reason}' if worker.reason else ''}."
        for worker in idle[:NAMED]
    ]
    more = len(idle) - NAMED
    return [*lines, f"{more} more don't work: see `embomatrix cluster workers`."] if more > 0 else lines
