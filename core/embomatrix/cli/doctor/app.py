"""`embomatrix doctor`: checks of this machine and of the connection to a manager."""

import asyncio
import importlib.util
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from embomatrix.cli.cluster.tables import show_json
from embomatrix.cli.connection import AsJson
from embomatrix.cli.doctor.machine import NEEDED, Finding, Level, machine, verdict
from embomatrix.cli.doctor.manager import Visit, manager, ports_held
from embomatrix.host.failure import MENDABLE, fail
from embomatrix.host.printable import printable
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.options import Ca, Manager, Token
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.trust import read_ca, read_token

STYLES: Final[Mapping[Level, str]] = {Level.FINE: "green", Level.NOTE: "yellow", Level.WRONG: "red"}


def doctor(
    manager: Manager = "",
    token: Token = "",
    ca: Ca = None,
    page_port: Annotated[
        int, typer.Option(help="Port of its status page, to compare clocks.", min=1, max=65535)
    ] = 8070,
    as_json: AsJson = False,
) -> None:
    """Check this machine, its fitness as a worker, and the connection to a manager. Exits with 2 if something is wrong."""
    try:
        addresses = Managers(manager or DEFAULT_ADDRESS).addresses
        secret, trusted = read_token(token), read_ca(ca)
    except ClusterError as error:
        fail("doctor", str(error))
    visits = [
        Visit(address, secret, trusted or _joined_authority(address), page_port, expected=bool(manager))
        for address in addresses
    ]
    findings_by_visit = asyncio.run(_visit(visits))
    held = frozenset().union(
        *(ports_held(visit, found) for visit, found in zip(visits, findings_by_visit, strict=True))
    )
    findings = [*machine(held), *_as_worker(), *itertools.chain.from_iterable(findings_by_visit)]
    if as_json:
        show_json(findings)
    else:
        _show(findings)
    if any(finding.level is Level.WRONG for finding in findings):
        raise SystemExit(MENDABLE)


def _is_worker() -> bool:
    """Return whether the worker's packages are installed."""
    return all(importlib.util.find_spec(name) for name in NEEDED["worker"])


def _joined_authority(address: str) -> bytes:
    """Return the authority of a manager that a worker of this machine has joined by invitation; empty without one."""
    if not _is_worker():
        return b""
    from embomatrix.worker.host.settings import WorkerSettings
    from embomatrix.worker.link.membership import authority_of

    return authority_of(address, WorkerSettings.model_validate({}).state_dir)


def _as_worker() -> Iterator[Finding]:
    """Yield findings about this machine as a worker, if the worker's packages are installed."""
    if _is_worker():
        from embomatrix.cli.doctor.worker import worker

        yield from worker()


async def _visit(visits: Sequence[Visit]) -> list[list[Finding]]:
    """Check all managers at the same time."""
    return await asyncio.gather(*(manager(visit) for visit in visits))


def _show(findings: Sequence[Finding]) -> None:
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        found = Text(printable(finding.found))
        if finding.remedy:
            found.append(f"\n{printable(finding.remedy)}", style="dim")
        table.add_row(
            Text(finding.level.value, style=STYLES[finding.level]), Text(printable(finding.thing)), found
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(f"\n{printable(verdict(findings))}", markup=False)
