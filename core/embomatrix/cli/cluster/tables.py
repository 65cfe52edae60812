"""Output of `embomatrix cluster`: tables, lines and JSON."""

import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

from pydantic import TypeAdapter
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from embomatrix.host.printable import printable
from embomatrix.rpc.wire.run_log import EventKind, RolloutStep, RunEvent
from embomatrix.rpc.wire.values import PlanCell, ResidentState, RunInfo, Warmth, WorkerInfo

STATE_STYLES: Final[Mapping[str, str]] = {
    "ready": "green",
    "lost": "red",
    "quarantined": "red",
    "left": "dim",
}
WARMTH_STYLES: Final[Mapping[Warmth, str]] = {
    Warmth.WARM: "green",
    Warmth.WARMING: "yellow",
    Warmth.QUEUED: "dim",
    Warmth.UNPLACEABLE: "red",
}
WIDEST: Final = 1000
SENTENCE: Final = 60
GRID: Final = 100
"""Most characters of a table line, of a column of sentences, and of the scenes of a step."""
NAMED: Final = 3
"""Most workers named in a look-ahead cell."""
_BAD: Final = frozenset((EventKind.FAILED, EventKind.WORKER_LOST, EventKind.SCENE_FAILED))


def show(table: Table) -> None:
    """Print a table without cutting it: lines wrap in a narrow terminal."""
    console = Console()
    whole = Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
    Console(width=max(whole, console.width)).print(table)


def show_json(value: object) -> None:
    """Print a value as JSON; dataclasses become objects."""
    plain = partial(TypeAdapter(Any).dump_python, mode="json")
    print(printable(json.dumps(value, default=plain, ensure_ascii=False)))


def event_plain(event: RunEvent) -> dict[str, Any]:
    """Return the fields of an event that are set."""
    return {name: value for name, value in event._asdict().items() if value or name == "sequence"}


def worker_table(workers: Sequence[WorkerInfo]) -> Table:
    table = _table(
        "worker", "state", slots=1, busy=1, done=1, warm=1, **{"memory MB": 1, "silent s": 1, "why": 0}
    )
    for worker in workers:
        warm = sum(resident.state is ResidentState.WARM for resident in worker.residents)
        state = Text(printable(worker.state), style=STATE_STYLES.get(worker.state, "yellow"))
        table.add_row(
            Text(printable(worker.worker_id)),
            state,
            str(worker.resources.slots),
            str(worker.running),
            str(worker.completed),
            str(warm),
            str(worker.resources.memory_mb),
            f"{worker.last_seen_s:.1f}",
            Text(printable(worker.reason)),
        )
    return table


def run_table(runs: Sequence[RunInfo]) -> Table:
    figures = ("done", "open", "failed", "again", "late", "prewarm hits", "wasted", "shared")
    table = _table("run", "name", "state", **dict.fromkeys(figures, 1), **{"waits for": 0})
    for run in runs:
        stats = run.stats
        asked = stats.prewarm_hits + stats.prewarm_misses
        counts = (stats.delivered, run.pending, stats.infra_failures, stats.redispatched, stats.stale_results)
        table.add_row(
            Text(printable(run.run_id)),
            Text(printable(run.name)),
            f"closed {_ago(run.closed_s)}" if run.closed_s else "open",
            *map(str, counts),
            f"{stats.prewarm_hits}/{asked}" if asked else "-",
            str(stats.prewarm_wasted),
            f"{stats.shared_share:.0%}" if stats.steps else "-",
            Text(printable(run.waits_for)),
        )
    return table


def plan_table(cells: Sequence[PlanCell]) -> Table:
    """Draw one row per step with its scenes as ``scene·rollouts·warmth@workers``, coloured by warmth."""
    table = _table("run", "step")
    table.add_column("scenes", overflow="fold", max_width=GRID)
    rows: dict[tuple[str, int], list[Text]] = {}
    for cell in cells:
        scene = cell.bundle_digest.removeprefix("sha256:")[:8]
        more = len(cell.worker_ids) - NAMED
        names = (*cell.worker_ids[:NAMED], *([f"{more}_more"] if more > 0 else []))
        label = f"{scene}·{cell.count}·{cell.warmth.value}" + (f"@{','.join(names)}" if names else "")
        rows.setdefault((cell.run_id, cell.step), []).append(
            Text(printable(label), style=WARMTH_STYLES[cell.warmth])
        )
    for (run_id, step), labels in sorted(rows.items()):
        table.add_row(Text(printable(run_id)), str(step), Text("  ").join(labels))
    return table


def event_line(event: RunEvent) -> Text:
    """Format an event as one line: time, kind, and fields as ``name=value``."""
    at = time.strftime("%H:%M:%S", time.gmtime(event.at_s)) + f".{int(event.at_s % 1 * 1000):03d}"
    named = (
        ("batch", event.batch_id),
        ("rollout", event.rollout_id),
        ("attempt", event.attempt),
        ("worker", event.worker_id),
        ("slot", event.slot),
        ("scene", event.bundle_digest.removeprefix("sha256:")[:8]),
        ("size", event.size),
        ("code", event.code),
    )
    line = Text(f"{at} ", style="dim", no_wrap=True)
    line.append(f"{event.kind.value:<14}", style="red" if event.kind in _BAD else "default")
    line.append(printable("".join(f" {name}={value}" for name, value in named if value)), style="default")
    if event.timings is not None:
        line.append(f" execute={event.timings.execute_s * 1e3:.1f}ms", style="default")
    return line.append(printable(f" {event.message}") if event.message else "", style="default")


def step_line(step: RolloutStep, begin_s: float) -> Text:
    """Format a step of a rollout's history as one line, with seconds since the first step."""
    at = time.strftime("%H:%M:%S", time.gmtime(step.at_s))
    line = Text(f"{at} +{step.at_s - begin_s:.3f} s ", style="dim", no_wrap=True)
    line.append(printable(f"{step.kind:<10}"), style="default")
    line.append(printable(f" {step.worker_id}:") if step.worker_id else "", style="default")
    line.append(printable(f" {step.reason}") if step.reason else "", style="default")
    return line.append(printable(f"  ({step.cause})"), style="dim")


def _table(*names: str, **figures: int) -> Table:
    """Make a table with text columns ``names`` and further columns: 1 for numbers, 0 for sentences that may wrap."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in names:
        table.add_column(name, no_wrap=True)
    for name, is_number in figures.items():
        if is_number:
            table.add_column(name, justify="right", no_wrap=True)
        else:
            table.add_column(name, overflow="fold", max_width=SENTENCE)
    return table


def _ago(at_s: float) -> str:
    seconds = max(0.0, time.time() - at_s)
    for unit, length_s in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length_s:
            return f"{seconds / length_s:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"
