"""`embomatrix cluster`: the operator's command line for a manager."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Annotated, Final, TypeVar

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.cli.cluster.tables import (
    event_line,
    event_plain,
    plan_table,
    run_table,
    show,
    show_json,
    step_line,
    worker_table,
)
from embomatrix.cli.cluster.trace import TRACE_MARK, chrome_trace
from embomatrix.cli.connection import AsJson, manager_command
from embomatrix.host.commands import command_group
from embomatrix.host.failure import fail, unwritable
from embomatrix.host.own_files import PAGE_MARK, Force, keep_foreign, prepare_output
from embomatrix.host.printable import printable
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.wire.run_log import EventPage, RunEvent
from embomatrix.world.whole_file import write_whole

T = TypeVar("T")
FOLLOW_S: Final = 0.5
"""Pause between two requests of `events --follow`."""

app = command_group(
    help="Inspect and control a cluster: workers, runs, look-ahead, reports, traces, and the history of a rollout."
)

Worker = Annotated[str, typer.Argument(help="Id of a worker, as `embomatrix cluster workers` shows it.")]
Run = Annotated[str, typer.Argument(help="Id or name of a run, as `embomatrix cluster runs` shows it.")]
Out = Annotated[Path | None, typer.Option(help="File to write.", show_default=False)]


@app.command()
@manager_command("cluster")
async def workers(client: AdminClient, as_json: AsJson = False) -> None:
    """List workers: state, slots, scenes, and why one does not work."""
    found = await client.list_workers()
    _list(found, worker_table, "no workers: start one with `embomatrix worker run`", as_json)


@app.command()
@manager_command("cluster")
async def runs(
    client: AdminClient,
    closed: Annotated[bool, typer.Option("--closed", help="List closed runs that are still kept.")] = False,
    as_json: AsJson = False,
) -> None:
    """List open runs, or closed ones."""
    found = await client.list_runs(closed=closed)
    nothing = "no closed runs are kept" if closed else "no open runs; closed ones: --closed"
    _list(found, run_table, nothing, as_json)


@app.command()
@manager_command("cluster")
async def plan(
    client: AdminClient,
    run: Annotated[str, typer.Argument(help="Show this run only, by its id or name.")] = "",
    as_json: AsJson = False,
) -> None:
    """Show the look-ahead: scenes of each coming step, how warm they are, and on which workers."""
    nothing = "no look-ahead: no trainer has announced coming steps with AnnounceLookahead"
    cells = await client.plan(await client.find_run(run) if run else "")
    _list(cells, plan_table, nothing, as_json)


@app.command()
@manager_command("cluster", until_interrupted=True)
async def events(
    client: AdminClient,
    run: Annotated[
        str, typer.Argument(help="Log of the run of this id or name; else of workers and scenes.")
    ] = "",
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for further events until interrupted.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print the log of a run, or of the workers, one event per line."""
    console = Console(soft_wrap=True, highlight=False)
    run_id = await client.find_run(run) if run else ""
    async for event in log_events(lambda after: client.read_events(run_id, after=after), follow=follow):
        if as_json:
            show_json(event_plain(event))
        else:
            console.print(event_line(event))


@app.command()
@manager_command("cluster")
async def explain(
    client: AdminClient,
    rollout: Annotated[str, typer.Argument(help="Id of a rollout, as events and log lines name it.")],
    as_json: AsJson = False,
) -> None:
    """Explain a rollout: when it was queued and leased, where and why, and what became of it."""
    found = await client.explain(rollout)
    if as_json:
        show_json({"steps": [step._asdict() for step in found.steps], "place": found.place})
        return
    console = Console(soft_wrap=True, highlight=False)
    begin_s = found.steps[0].at_s if found.steps else 0.0
    for step in found.steps:
        console.print(step_line(step, begin_s))
    console.print(f"now: {printable(found.place) or 'it has its outcome'}", markup=False)


@app.command()
@manager_command("cluster")
async def report(
    client: AdminClient,
    run: Run,
    out: Out = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures instead.")] = False,
    force: Force = False,
) -> None:
    """Write the report of an open or closed run as one self-contained HTML file, ID.html by default."""
    if not as_json:
        prepare_output("cluster report", out)
    run_id = await client.find_run(run)
    summary = await client.run(run_id)
    if as_json:
        show_json(summary)
        return
    from embomatrix.cli.cluster.report import report_page

    file = out or _free(Path(f"{run_id}.html"), PAGE_MARK, force=force)
    _write(file, report_page(summary, await client.all_events(run_id)))


@app.command()
@manager_command("cluster")
async def trace(client: AdminClient, run: Run, out: Out = None, force: Force = False) -> None:
    """Write a run as a Chrome trace for https://ui.perfetto.dev, ID.trace.json by default."""
    prepare_output("cluster trace", out)
    run_id = await client.find_run(run)
    file = out or _free(Path(f"{run_id}.trace.json"), TRACE_MARK, force=force)
    summary = await client.run(run_id)
    page = chrome_trace(
        await client.all_events(run_id), await client.all_events(), summary.run.name or run_id
    )
    _write(file, json.dumps(page, separators=(",", ":")))


@app.command()
@manager_command("cluster")
async def close(client: AdminClient, run: Run, as_json: AsJson = False) -> None:
    """Close an open run whose trainer will not come back: its rollouts are cancelled, and no scene is kept for it."""
    run_id = await client.find_run(run)
    stats = await client.close_run(run_id)
    _done(as_json, run=run_id, state="closed", delivered=str(stats.delivered))


@app.command()
@manager_command("cluster")
async def drain(client: AdminClient, name: Worker, as_json: AsJson = False) -> None:
    """Drain a worker: it finishes its leases and gets nothing new."""
    await client.drain_worker(name)
    _done(as_json, worker=name, state="draining")


@app.command()
@manager_command("cluster")
async def resume(
    client: AdminClient,
    name: Annotated[str, typer.Argument(help="Id of a worker; without it, dispatch is resumed.")] = "",
    as_json: AsJson = False,
) -> None:
    """End the drain or quarantine of a worker, or resume paused dispatch."""
    if name:
        await client.resume(name)
        _done(as_json, worker=name, state="ready")
    else:
        await client.resume_dispatch()
        _done(as_json, dispatch="running")


@app.command()
@manager_command("cluster")
async def pause(client: AdminClient, as_json: AsJson = False) -> None:
    """Pause dispatch: no worker gets new leases, running rollouts continue."""
    await client.pause_dispatch()
    _done(as_json, dispatch="paused")


@app.command()
@manager_command("cluster")
async def revoke(
    client: AdminClient,
    name: Worker,
    reason: Annotated[str, typer.Option(help="Reason shown to the worker's owner.")],
    as_json: AsJson = False,
) -> None:
    """Expel a worker: its credential becomes void, and its leases are re-dispatched."""
    await client.revoke_worker(name, reason)
    _done(as_json, worker=name, state="revoked")


async def log_events(
    read: Callable[[int], Awaitable[EventPage]], *, follow: bool, pause_s: float = FOLLOW_S
) -> AsyncIterator[RunEvent]:
    """Yield the events of a log, oldest first; with ``follow`` also the coming ones, without end.

    ``read`` returns a page of the events with a higher sequence number. A page of a followed log begins with the last known
    event, if it is the same log: a manager that starts anew numbers its events from 1, so its log is read from its begin.
    """
    last: RunEvent | None = None
    while True:
        events = (await read(0 if last is None else last.sequence - follow)).events
        if last is not None and follow:
            if not events or (events[0].sequence, events[0].at_s) != (last.sequence, last.at_s):
                last = None
                await asyncio.sleep(pause_s)
                continue
            events = events[1:]
        for event in events:
            yield event
        if events:
            last = events[-1]
        elif follow:
            await asyncio.sleep(pause_s)
        else:
            return


def _list(found: Sequence[T], table: Callable[[Sequence[T]], Table], nothing: str, as_json: bool) -> None:
    if as_json:
        show_json(found)
    elif found:
        show(table(found))
    else:
        print(nothing)


def _free(path: Path, mark: bytes, *, force: bool) -> Path:
    """Return the path of a file whose name the user did not choose. Exit if another file has it."""
    keep_foreign("cluster", [path], mark, force=force)
    return path


def _write(path: Path, text: str) -> None:
    try:
        write_whole(path, text.encode("utf-8"))
    except OSError as error:
        fail("cluster", unwritable(path, error))
    print(f"{path}: {len(text) / 1e6:.1f} MB")


def _done(as_json: bool, **changed: str) -> None:
    if as_json:
        show_json(changed)
    else:
        print(", ".join(f"{name} {value}" for name, value in changed.items()))
