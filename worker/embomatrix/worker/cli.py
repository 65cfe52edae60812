"""`embomatrix worker`: lend this machine to a manager, or check that it can be lent."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import platform
import signal
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import numpy as np
import typer
from pydantic import ValidationError
from rich.console import Console
from rich.table import Table

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.logs import LogFormat, bind, hide, log_to_stderr
from embomatrix.rpc.status import ClusterError, ManagerUnreachableError
from embomatrix.worker.daemon import Daemon, serve
from embomatrix.worker.membership import membership_of
from embomatrix.worker.processes import ProcessGoneError, start_root
from embomatrix.worker.resources import measure
from embomatrix.worker.settings import WorkerSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Lend this machine's cores to a manager.",
)
console = Console()

EXPECTED: Final[Mapping[str, str]] = {
    "manager": f"expected HOST:PORT, as in {DEFAULT_ADDRESS}",
    "name": "expected up to 64 letters, digits, '.', '_' and '-'",
}
"""What to say of a wrong value where the validator only knows a pattern."""

Manager = Annotated[
    str, typer.Option(help="HOST:PORT of the manager, or of several: A,B.", envvar="EMBOMATRIX_MANAGER")
]
Token = Annotated[
    str,
    typer.Option(
        envvar="EMBOMATRIX_TOKEN", help="Token of a worker, or @FILE that holds it.", show_default=False
    ),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        envvar="EMBOMATRIX_CA", help="The ca.pem of a manager that serves by TLS.", show_default=False
    ),
]

Join = Annotated[
    str,
    typer.Option(
        envvar="EMBOMATRIX_JOIN",
        help="TOKEN@HOST:PORT as the operator got it: all that joining takes.",
        show_default=False,
    ),
]
CacheDir = Annotated[Path | None, typer.Option(help="Folder for bundles and the simulator's log.")]
StateDir = Annotated[
    Path | None, typer.Option(help="Folder of this machine's credentials.", show_default=False)
]
LogLines = Annotated[
    LogFormat, typer.Option(help="Log lines for people, or as JSON.", envvar="EMBOMATRIX_LOG_FORMAT")
]


@app.command()
def run(
    manager: Manager = DEFAULT_ADDRESS,
    slots: Annotated[int, typer.Option(help="Rollouts at the same time; 0: one for each core.")] = 0,
    token: Token = "",
    join: Join = "",
    ca: Ca = None,
    name: Annotated[str, typer.Option(help="Worker id; by default the host's name and a random part.")] = "",
    cache_dir: CacheDir = None,
    memory_mb: Annotated[int, typer.Option(help="Memory for scenes; 0: four tenths of what is free.")] = 0,
    nice: Annotated[int, typer.Option(help="Politeness, 0 to 19.")] = 10,
    state_dir: StateDir = None,
    once: Annotated[bool, typer.Option(help="End when the manager can't be reached.")] = False,
    verbose: Annotated[bool, typer.Option(help="Log every rollout.")] = False,
    log_format: LogLines = LogFormat.HUMAN,
) -> None:
    """Join the manager and execute rollouts until stopped: Ctrl-C drains, a second one leaves at once."""
    _check_engine()
    values: dict[str, Any] = {
        "manager": manager,
        "slots": slots,
        "token": token,
        "join": join,
        "ca": ca,
        "memory_mb": memory_mb,
        "nice": nice,
        "once": once,
    }
    # Left out, these have defaults that are not one value for all.
    chosen = {"name": name or None, "state_dir": state_dir, "cache_dir": cache_dir}
    settings = _settings({**values, **{key: value for key, value in chosen.items() if value is not None}})
    log_to_stderr("debug" if verbose else "info", log_format)
    hide(settings.token)
    hide(settings.join)
    os.nice(settings.nice)
    try:
        asyncio.run(_serve(settings))
    except (ClusterError, ProcessGoneError) as error:
        _fail(str(error))
    except OSError as error:
        where = error.filename or settings.cache_dir
        _fail(f"{where} can't be used ({error.strerror or error}): name another folder with --cache-dir")


async def _serve(settings: WorkerSettings) -> None:
    membership = await membership_of(settings)
    bind("worker", membership.name)
    daemon = Daemon(settings, measure(settings), np.random.default_rng(), membership=membership)
    await serve(daemon, (signal.SIGINT, signal.SIGTERM))


@app.command()
def doctor(manager: Manager = DEFAULT_ADDRESS, token: Token = "", ca: Ca = None) -> None:
    """Check what a worker needs: the engine, its processes, memory, and a manager that answers."""
    _check_engine()
    settings = _settings({"manager": manager, "token": token, "ca": ca})
    resources = measure(settings)
    table = Table(box=None, show_header=False, padding=(0, 2))
    table.add_row("python", f"{platform.python_version()} on {platform.machine()}")
    table.add_row("engine", f"pybullet {resources.versions['pybullet']}")
    table.add_row("platform", resources.versions["platform"])
    table.add_row("slots", f"{resources.slots} (cores)")
    table.add_row("memory for scenes", f"{resources.memory_mb} MB")
    table.add_row("speed", f"{resources.score:.2f} of the reference")
    table.add_row(
        "gpu", f"{resources.gpu}, {resources.vram_mb} MB" if resources.gpu else "none (none is needed)"
    )
    try:
        started_s, memory_mb = asyncio.run(_try_simulator())
    except ProcessGoneError as error:
        console.print(table)
        _fail(str(error))
    table.add_row("simulator", f"starts in {started_s:.1f} s, {memory_mb:.0f} MB")
    try:
        workers = asyncio.run(_ask_manager(settings))
    except ManagerUnreachableError as error:
        console.print(table)
        _fail(str(error))
    except ClusterError as error:
        # A worker's token may not list the workers: the manager answered, which is what was asked.
        workers = f"answers ({error})"
    table.add_row("manager", workers)
    console.print(table)


async def _try_simulator() -> tuple[float, float]:
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        root = await start_root(Path(folder) / "simulator.log")
        elapsed_s = time.monotonic() - started_s
        await root.end()
    return elapsed_s, root.memory_mb


async def _ask_manager(settings: WorkerSettings) -> str:
    member = await membership_of(settings)
    limits = ClientLimits(call_s=5.0)
    async with ClusterClient(member.manager, member.token, ca=member.ca, limits=limits) as client:
        workers = await client.list_workers()
    return f"answers at {member.manager}, {len(workers)} workers"


def _check_engine() -> None:
    """End with a sentence where the engine is not installed; it is not imported here."""
    if importlib.util.find_spec("pybullet") is None:
        _fail(
            f"a worker needs the physics engine pybullet, and this Python {platform.python_version()} on "
            f"{platform.machine()} has none: use Python 3.11 on x86-64 Linux and install it with "
            "`pip install 'embomatrix[worker]'`"
        )


def _settings(values: dict[str, Any]) -> WorkerSettings:
    try:
        return WorkerSettings(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        if name == "token":
            # What was found stays untold: it may be nearly the secret.
            _fail("--token: expected visible ASCII characters without spaces")
        expected = EXPECTED.get(name) or first["msg"][:1].lower() + first["msg"][1:]
        _fail(f"--{name.replace('_', '-')} {first['input']!r}: {expected}")


def _fail(sentence: str) -> NoReturn:
    Console(stderr=True, soft_wrap=True).print(
        f"embomatrix worker: {sentence}", highlight=False, markup=False
    )
    raise typer.Exit(2)
