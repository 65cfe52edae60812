"""Tables of `embomatrix manager status`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import ResidentState

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import RunInfo, WorkerInfo


async def show_status(address: str, token: str, ca: bytes = b"") -> None:
    """Print the workers and runs of the manager at HOST:PORT. Raises ClusterError."""
    async with ClusterClient(address, token, ca=ca) as client:
        workers, runs = await client.list_workers(), await client.list_runs()
    console = Console()
    console.print(_worker_table(workers) if workers else "no workers: start one with `embomatrix worker run`")
    console.print(_run_table(runs) if runs else "no open runs")


def _worker_table(workers: tuple[WorkerInfo, ...]) -> Table:
    table = Table("worker", "state", "slots", "running", "completed", "warm scenes", "memory MB", "silent s")
    for worker in workers:
        warm = sum(resident.state is ResidentState.WARM for resident in worker.residents)
        table.add_row(
            worker.worker_id,
            worker.state,
            str(worker.resources.slots),
            str(worker.running),
            str(worker.completed),
            str(warm),
            str(worker.resources.memory_mb),
            f"{worker.last_seen_s:.1f}",
        )
    return table


def _run_table(runs: tuple[RunInfo, ...]) -> Table:
    table = Table("run", "name", "pending", "delivered", "failures", "re-dispatched", "late", "prewarm hits")
    for run in runs:
        stats = run.stats
        asked = stats.prewarm_hits + stats.prewarm_misses
        hits = f"{stats.prewarm_hits}/{asked}" if asked else "-"
        counts = (run.pending, stats.delivered, stats.infra_failures, stats.redispatched, stats.stale_results)
        table.add_row(run.run_id, run.name, *map(str, counts), hits)
    return table
