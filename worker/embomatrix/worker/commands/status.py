"""`embomatrix worker status`: current state of the daemons of this machine."""

import json
import time
from dataclasses import asdict
from typing import Annotated

import typer
from rich.console import Console

from embomatrix.host.printable import printable
from embomatrix.worker.commands.options import StateDir, fail
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.status import WorkerStatus, running_daemons


def status(
    state_dir: StateDir = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list.")] = False,
) -> None:
    """Show the workers of this machine: their manager, running rollouts, and pauses."""
    folder = state_dir or WorkerSettings.model_fields["state_dir"].default
    daemons = running_daemons(folder)
    if as_json:
        typer.echo(json.dumps([asdict(daemon) for daemon in daemons], indent=2))
        return
    if not daemons:
        fail(f"no worker of {folder} runs on this machine: start one with `embomatrix worker run`")
    console = Console(soft_wrap=True)
    for daemon in daemons:
        for line in describe(daemon, time.time()):
            console.print(printable(line), highlight=False, markup=False)


def describe(status: WorkerStatus, now_s: float) -> list[str]:
    """Describe the status in lines; ``now_s`` is wall time."""
    if status.connected_since_s:
        reach = f"connected to {status.manager} for {format_duration(now_s - status.connected_since_s)}"
    else:
        reach = f"not connected to {status.manager or 'a manager'} at present; it keeps trying"
    state = (
        "draining: leaves after the running rollouts"
        if status.draining
        else f"paused: {status.paused}"
        if status.paused
        else "working"
        if status.running
        else "waiting for work"
    )
    return [
        f"{status.name} (process {status.pid}), running for {format_duration(now_s - status.started_s)}",
        f"  {reach}",
        f"  {state}",
        f"  {status.running} of {status.slots} slots run a rollout, {status.waiting} more wait",
        f"  {status.completed} rollouts completed, {status.failed} failed; "
        f"{status.unacknowledged} results on their way to the manager",
        f"  {status.scenes} scenes in {status.memory_used_mb:.0f} of {status.memory_mb:.0f} MB of memory",
        f"  bundles take {status.cache_used_mb:.1f} of {status.cache_mb:.0f} MB of disk",
    ]


def format_duration(seconds: float) -> str:
    """Format a duration in its two largest units: ``3 h 12 min``."""
    whole = max(0, int(seconds))
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {whole % 60} s" if minutes else f"{whole} s"
