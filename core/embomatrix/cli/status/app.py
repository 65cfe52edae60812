"""`embomatrix status` and `embomatrix top`: how a cluster does, in words and live."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console
from rich.live import Live

from embomatrix.cli.cluster.tables import show_json
from embomatrix.cli.connection import Ca, Manager, Token  # noqa: TC001  typer reads the annotations when a command runs
from embomatrix.cli.failure import fail
from embomatrix.cli.status.live import Glance, earliest, screen
from embomatrix.cli.status.words import sentences
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.status import ClusterError, UnavailableError
from embomatrix.rpc.trust import read_ca, read_token

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from pathlib import Path

REFRESH_S: Final = 1.0
RATE_S: Final = 5.0
"""Throughput is that of so many seconds."""
FAILOVER_S: Final = 2.0
"""For a manager that is away: who looks on wants to know."""


def status(
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Tell in a few sentences how the cluster does: workers, runs, what is warm, and who doesn't work and why."""

    async def ask() -> None:
        async with _client(manager, token, ca) as client:
            fleet, runs, plan = await asyncio.gather(client.fleet(), client.list_runs(), client.plan())
        told = sentences(fleet, runs, plan)
        if as_json:
            show_json({"sentences": told, "workers": fleet.workers, "runs": runs, "plan": plan})
            return
        console = Console(highlight=False)
        for sentence in told:
            console.print(sentence, markup=False)

    _ask("status", ask())


def top(
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    rounds: Annotated[int, typer.Option(help="End after so many looks; 0: go on until Ctrl-C.", min=0)] = 0,
) -> None:
    """Watch the cluster live: throughput, runs, and workers, those that don't work first. Ctrl-C ends it."""

    async def watch() -> None:
        console = Console(highlight=False)
        glances: deque[Glance] = deque(maxlen=int(RATE_S / REFRESH_S) + 1)
        looks = 0
        async with _client(manager, token, ca) as client:
            glances.append(await _look(client))
            with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
                while True:
                    live.update(
                        screen(earliest(glances, RATE_S), glances[-1], lines=console.height), refresh=True
                    )
                    looks += 1
                    if looks == rounds:
                        return
                    await asyncio.sleep(REFRESH_S)
                    # One that restarts ends nobody's watch.
                    with contextlib.suppress(UnavailableError):
                        glances.append(await _look(client))

    with contextlib.suppress(KeyboardInterrupt):
        _ask("top", watch())


async def _look(client: AdminClient) -> Glance:
    fleet, runs = await asyncio.gather(client.fleet(), client.list_runs())
    return Glance(time.monotonic(), fleet, runs)


def _client(manager: str, token: str, ca: Path | None) -> AdminClient:
    return AdminClient(manager, read_token(token), ca=read_ca(ca), failover_s=FAILOVER_S)


def _ask(command: str, question: Coroutine[None, None, None]) -> None:
    try:
        asyncio.run(question)
    except ClusterError as error:
        fail(command, str(error))
