"""`embomatrix worker run`: options over a settings file, and the daemon that they configure."""

import asyncio
import contextlib
import enum
import logging
import os
import signal
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Protocol

import numpy as np
import psutil
import typer

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.logs import LogFormat, bind, hide, log_to_stderr
from embomatrix.rpc.options import Ca, LogLines, Manager, Token
from embomatrix.rpc.status import ClusterError
from embomatrix.worker.commands.options import StateDir, check_engine, fail, parse
from embomatrix.worker.host.machine import HostMachine
from embomatrix.worker.host.owner_policy import Preferences
from embomatrix.worker.host.resources import measure
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon, serve
from embomatrix.worker.link.membership import membership_of
from embomatrix.worker.link.status import daemon_pids
from embomatrix.worker.slots.processes import ProcessGoneError

logger = logging.getLogger(__name__)

PREFERENCES: Final = frozenset(Preferences.model_fields)
NOT_SETTINGS: Final = frozenset({"config", "labels", "verbose", "log_format"})
"""Options that are no settings of the daemon, or have another name there."""


def run(
    context: typer.Context,
    manager: Manager = DEFAULT_ADDRESS,
    slots: Annotated[int, typer.Option(help="Concurrent rollouts; 0: one for each core.")] = 0,
    token: Token = "",
    join: Annotated[
        str,
        typer.Option(
            envvar="EMBOMATRIX_JOIN",
            help="Invitation TOKEN@HOST:PORT of the operator, instead of --manager and --token.",
            show_default=False,
        ),
    ] = "",
    ca: Ca = None,
    name: Annotated[str, typer.Option(help="Worker id; by default the host's name and a random part.")] = "",
    labels: Annotated[
        list[str] | None, typer.Option("--label", help="KEY=VALUE, for operators; repeatable.")
    ] = None,
    hours: Annotated[str, typer.Option(help="Work only in these hours: 18:00-08:00, local time.")] = "",
    idle_s: Annotated[
        float, typer.Option(help="Work only after this many seconds without a sign of a user.")
    ] = 0.0,
    mains_only: Annotated[bool, typer.Option("--mains-only", help="Pause on battery.")] = False,
    max_load: Annotated[
        float,
        typer.Option(help="Pause if other programs use more than this share of all cores, such as 0.5."),
    ] = 0.0,
    memory_mb: Annotated[
        int, typer.Option(help="Memory for scenes in MB; 0: a share of the free memory.")
    ] = 0,
    memory_share: Annotated[float, typer.Option(help="Share of the free memory for scenes.")] = 0.4,
    cache_dir: Annotated[Path | None, typer.Option(help="Folder of bundles and the simulator's log.")] = None,
    cache_mb: Annotated[int, typer.Option(help="Disk space for bundles in MB.")] = 1024,
    nice: Annotated[
        int, typer.Option(help="Nice value of the CPU, 0 to 19; above 0 the disk has idle priority, too.")
    ] = 10,
    state_dir: StateDir = None,
    config: Annotated[
        Path | None,
        typer.Option(help="TOML file of these options; options on the command line take precedence."),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Exit if the manager can't be reached.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log every rollout.")] = False,
    log_format: LogLines = LogFormat.HUMAN,
) -> None:
    """Join the manager and execute rollouts until stopped. Ctrl-C drains; a second Ctrl-C exits at once."""
    check_engine()
    settings = parse(values_of(context, config, labels or []))
    log_to_stderr("debug" if verbose else "info", log_format)
    hide(settings.token)
    hide(settings.join)
    lower_priority(settings.nice)
    try:
        asyncio.run(_serve(settings))
    except (ClusterError, ProcessGoneError) as error:
        fail(str(error))
    except OSError as error:
        where = error.filename or settings.cache_dir
        fail(f"{where} can't be used ({error.strerror or error}): name another folder with --cache-dir")


class CommandLine(Protocol):
    """Parsed command line: values by option name, and the source of each."""

    params: dict[str, Any]

    def get_parameter_source(self, name: str, /) -> enum.Enum | None: ...


def settings_of(words: Sequence[str]) -> WorkerSettings:
    """Parse the options of `worker run`, or exit with a sentence about a wrong one."""
    parser = typer.Typer()
    parser.command()(run)
    context = typer.main.get_command(parser).make_context("embomatrix worker run", list(words))
    return parse(values_of(context, context.params["config"], context.params["labels"] or []))


def values_of(context: CommandLine, config: Path | None, labels: list[str]) -> dict[str, Any]:
    """Merge the file with options and environment variables, which take precedence."""
    values = read_config(config) if config is not None else {}
    preferences = values.setdefault("preferences", {})
    for name, value in context.params.items():
        source = context.get_parameter_source(name)
        if name in NOT_SETTINGS or source is None or source.name.startswith("DEFAULT"):
            continue
        if name == "join" and not value:
            fail("--join is empty, perhaps an unset variable: expected TOKEN@HOST:PORT from the operator")
        (preferences if name in PREFERENCES else values)[name] = value
    if labels:
        values["labels"] = {**values.get("labels", {}), **dict(map(split_label, labels))}
    return values


def read_config(path: Path) -> dict[str, Any]:
    """Read a TOML file of options. Its values are validated with the others."""
    try:
        values = tomllib.loads(path.expanduser().read_text(encoding="utf-8"))
    except OSError as error:
        fail(f"--config {path}: the file can't be read ({error.strerror or error}): name a TOML file")
    except ValueError as error:
        fail(f"--config {path}: {error}: expected a TOML file")
    if not isinstance(values.get("preferences", {}), dict):
        fail(f"--config {path}: expected preferences to be a table, [preferences]")
    return values


def split_label(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not key or not equals:
        fail(f"--label {text!r}: expected KEY=VALUE, as in room=lab")
    return key, value


def lower_priority(nice: int) -> None:
    """Lower the CPU and disk priority of this process and its children."""
    os.nice(nice)
    if nice and sys.platform == "linux":
        # Some containers forbid it, and it is optional.
        with contextlib.suppress(psutil.Error, OSError):
            psutil.Process().ionice(psutil.IOPRIO_CLASS_IDLE)


async def _serve(settings: WorkerSettings) -> None:
    membership = await membership_of(settings)
    bind("worker", membership.name)
    machine = HostMachine(lambda: daemon_pids(settings.state_dir))
    if not settings.preferences.always:
        for sentence in machine.unsupported(settings.preferences, await asyncio.to_thread(machine.observe)):
            logger.warning("%s", sentence)
    daemon = Daemon(
        settings, measure(settings), np.random.default_rng(), membership=membership, probe=machine
    )
    await serve(daemon, (signal.SIGINT, signal.SIGTERM))
