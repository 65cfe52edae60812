"""`embomatrix cluster`: the operator's command line. Reads and steers a manager, wherever it runs."""

from __future__ import annotations

import asyncio
import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

import typer
from rich.console import Console

from embomatrix.cli.cluster.tables import (
    event_line,
    event_plain,
    plan_table,
    run_table,
    show,
    show_json,
    worker_table,
)
from embomatrix.cli.cluster.trace import chrome_trace
from embomatrix.cli.connection import Ca, Manager, Token  # noqa: TC001  typer reads the annotations when a command runs
from embomatrix.cli.failure import fail
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.trust import read_ca, read_token

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from embomatrix.rpc.wire.run_log import RunEvent, RunSummary

T = TypeVar("T")

FOLLOW_S: Final = 0.5
"""`events --follow` asks again after this long."""

app = typer.Typer(
    help="Look at a cluster and steer it: workers, runs, plan, reports and traces.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Worker = Annotated[str, typer.Argument(help="Id of the worker, as `embomatrix cluster workers` shows it.")]
Run = Annotated[str, typer.Argument(help="Id of the run, as `embomatrix cluster runs` shows it.")]


@app.command()
def workers(
    manager: Manager = DEFAULT_ADDRESS, token: Token = "", ca: Ca = None, as_json: AsJson = False
) -> None:
    """List the workers: state, slots, scenes, and why one does not work."""

    found = _asked(manager, token, ca, lambda client: client.list_workers())
    if as_json:
        show_json(found)
    elif found:
        show(worker_table(found))
    else:
        print("no workers: start one with `embomatrix worker run`")


@app.command()
def runs(
    closed: Annotated[bool, typer.Option("--closed", help="Those that are over and still kept.")] = False,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """List the runs that are open, or those that were closed."""

    found = _asked(manager, token, ca, lambda client: client.list_runs(closed=closed))
    if as_json:
        show_json(found)
    elif found:
        show(run_table(found))
    else:
        print("no closed runs are kept" if closed else "no open runs; closed ones: --closed")


@app.command()
def plan(
    run: Annotated[str, typer.Argument(help="Of this run only.")] = "",
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """Show the look-ahead grid: which scenes each coming step needs, how warm each is, and where."""

    cells = _asked(manager, token, ca, lambda client: client.plan(run))
    if as_json:
        show_json(cells)
    elif cells:
        show(plan_table(cells))
    else:
        print("nothing is announced: trainers tell the scenes of coming steps with AnnounceLookahead")


@app.command()
def drain(
    name: Worker,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """Take a worker out: it finishes what it holds and gets nothing new."""

    _asked(manager, token, ca, lambda client: client.drain_worker(name))
    _done(as_json, worker=name, state="draining")


@app.command()
def resume(
    name: Worker,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """Take a drain back, as long as the worker has not left."""

    _asked(manager, token, ca, lambda client: client.resume(name))
    _done(as_json, worker=name, state="ready")


@app.command()
def revoke(
    name: Worker,
    reason: Annotated[str, typer.Option(help="Why: its owner reads it.")],
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """Send a worker away for good: its credential is void, and what it held goes to others."""

    async def ask() -> None:
        async with AdminClient(manager, read_token(token), ca=read_ca(ca)) as client:
            await client.revoke_worker(name, reason)
        _done(as_json, worker=name, state="revoked")

    _ask(ask())


@app.command()
def pause(
    manager: Manager = DEFAULT_ADDRESS, token: Token = "", ca: Ca = None, as_json: AsJson = False
) -> None:
    """Give no new leases, to any worker; what runs goes on."""

    _asked(manager, token, ca, lambda client: client.pause_dispatch())
    _done(as_json, dispatch="paused")


@app.command("resume-dispatch")
def resume_dispatch(
    manager: Manager = DEFAULT_ADDRESS, token: Token = "", ca: Ca = None, as_json: AsJson = False
) -> None:
    """Give leases again."""

    _asked(manager, token, ca, lambda client: client.resume_dispatch())
    _done(as_json, dispatch="running")


@app.command()
def report(
    run: Run,
    out: Annotated[
        Path | None, typer.Option(help="File to write; else RUN.html.", show_default=False)
    ] = None,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures instead.")] = False,
) -> None:
    """Write what a run came to as one HTML file that needs nothing else; also after it was closed."""
    summary, events, _ = _ask(_read(manager, token, ca, run))
    if as_json:
        show_json(summary)
        return
    from embomatrix.cli.cluster.report import report_page

    _write(out or Path(f"{run}.html"), report_page(summary, events))


@app.command()
def trace(
    run: Run,
    out: Annotated[
        Path | None, typer.Option(help="File to write; else RUN.trace.json.", show_default=False)
    ] = None,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
) -> None:
    """Write a run as a Chrome trace: open it in https://ui.perfetto.dev."""
    summary, events, fleet = _ask(_read(manager, token, ca, run))
    text = json.dumps(chrome_trace(events, fleet, summary.run.name or run), separators=(",", ":"))
    _write(out or Path(f"{run}.trace.json"), text)


@app.command()
def events(
    run: Annotated[str, typer.Argument(help="Of this run; without it, of workers and scenes.")] = "",
    follow: Annotated[bool, typer.Option("--follow", help="Go on until interrupted.")] = False,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    as_json: AsJson = False,
) -> None:
    """Print the log of a run, or of the fleet, one event a line."""

    async def ask() -> None:
        console, after = Console(soft_wrap=True, highlight=False), 0
        async with _client(manager, token, ca) as client:
            while True:
                page = await client.read_events(run, after=after)
                for event in page.events:
                    if as_json:
                        show_json(event_plain(event))
                    else:
                        console.print(event_line(event))
                if page.events:
                    after = page.events[-1].sequence
                elif follow:
                    await asyncio.sleep(FOLLOW_S)
                else:
                    return

    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        _ask(ask())


async def _read(
    manager: str, token: str, ca: Path | None, run: str
) -> tuple[RunSummary, tuple[RunEvent, ...], tuple[RunEvent, ...]]:
    async with _client(manager, token, ca) as client:
        return await client.run(run), await client.all_events(run), await client.all_events()


def _client(manager: str, token: str, ca: Path | None) -> AdminClient:
    return AdminClient(manager, read_token(token), ca=read_ca(ca))


def _asked(
    manager: str, token: str, ca: Path | None, question: Callable[[AdminClient], Coroutine[None, None, T]]
) -> T:
    """The answer to one question to the manager."""

    async def ask() -> T:
        async with _client(manager, token, ca) as client:
            return await question(client)

    return _ask(ask())


def _ask(question: Coroutine[None, None, T]) -> T:
    """Put a question to the manager; what goes wrong is told in a sentence."""
    try:
        return asyncio.run(question)
    except ClusterError as error:
        fail("cluster", str(error))


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        fail("cluster", f"{path} can't be written ({error.strerror}): pass another --out")
    print(f"{path}: {len(text) / 1e6:.1f} MB")


def _done(as_json: bool, **told: str) -> None:
    if as_json:
        show_json(told)
    else:
        print(", ".join(f"{name} {value}" for name, value in told.items()))
