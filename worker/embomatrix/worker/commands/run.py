"""`embomatrix worker run`: options over a settings file, and the daemon that they configure."""

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import psutil
import typer

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.logs import LogFormat, LogTail, bind, hide, log_to_stderr
from embomatrix.rpc.options import (
    Ca,
    CommandLine,
    LogLines,
    Manager,
    Token,
    add_settings,
    given_options,
    read_config,
)
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.bounds import LOG_LINE
from embomatrix.worker.commands.options import StateDir, check_engine, fail, parse
from embomatrix.worker.host.machine import HostMachine
from embomatrix.worker.host.owner_policy import Preferences
from embomatrix.worker.host.resources import measure
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon, serve
from embomatrix.worker.link.membership import membership_of
from embomatrix.worker.link.status import daemon_pids, refuse_second_daemon
from embomatrix.worker.slots.processes import ProcessGoneError

logger = logging.getLogger(__name__)

PREFERENCES: Final = frozenset(Preferences.model_fields)
LINES_KEPT: Final = 50
"""Latest log lines that a manager gets after a reconnection."""
NOT_SETTINGS: Final = frozenset({"config", "labels", "verbose", "log_format"})
"""Options that are no settings of the daemon, or have another name there."""
FILE_ONLY: Final = ("preferences", "slot_memory_mb", "drain_s", "grace_s", "calm_s", "check_s")
"""Settings without an option: only the file of --config sets them."""


def run(
    context: typer.Context,
    manager: Manager = DEFAULT_ADDRESS,
    token: Token = "",
    ca: Ca = None,
    join: Annotated[
        str,
        typer.Option(
            envvar="EMBOMATRIX_JOIN",
            help="Invitation TOKEN@HOST:PORT of the operator, instead of --manager and --token.",
            show_default=False,
        ),
    ] = "",
    state_dir: StateDir = None,
    labels: Annotated[
        list[str] | None, typer.Option("--label", help="KEY=VALUE, for operators; repeatable.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="TOML file of these and further settings; options take precedence."),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log every rollout.")] = False,
    log_format: LogLines = LogFormat.HUMAN,
    **_: object,
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


add_settings(run, WorkerSettings, Preferences, skip=FILE_ONLY)


def settings_of(words: Sequence[str]) -> WorkerSettings:
    """Parse the options of `worker run`, or exit with a sentence about a wrong one."""
    parser = typer.Typer()
    parser.command()(run)
    context = typer.main.get_command(parser).make_context("embomatrix worker run", list(words))
    return parse(values_of(context, context.params["config"], context.params["labels"] or []))


def values_of(context: CommandLine, config: Path | None, labels: list[str]) -> dict[str, Any]:
    """Merge the file with options and environment variables, which take precedence."""
    values = read_config(config, fail) if config is not None else {}
    preferences = values.setdefault("preferences", {})
    if not isinstance(preferences, dict):
        fail(f"--config {config}: expected preferences to be a table, [preferences]")
    for name, value in given_options(context).items():
        if name in NOT_SETTINGS:
            continue
        if name == "join" and not value:
            fail("--join is empty, perhaps an unset variable: expected TOKEN@HOST:PORT from the operator")
        (preferences if name in PREFERENCES else values)[name] = value
    if labels:
        values["labels"] = {**values.get("labels", {}), **dict(map(split_label, labels))}
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
    tail = LogTail(kept=LINES_KEPT, characters=LOG_LINE)
    logging.getLogger("embomatrix").addHandler(tail)
    membership = await membership_of(settings)
    remedy = (
        "join this one with an invitation of its own" if settings.join else "give this one another --name"
    )
    refuse_second_daemon(settings.state_dir, membership, remedy=remedy)
    bind("worker", membership.name)
    machine = HostMachine(lambda: daemon_pids(settings.state_dir))
    if not settings.preferences.always:
        for sentence in machine.unsupported(settings.preferences, await asyncio.to_thread(machine.observe)):
            logger.warning("%s", sentence)
    daemon = Daemon(
        settings,
        measure(settings),
        np.random.default_rng(),
        membership=membership,
        probe=machine,
        log_tail=tail,
    )
    await serve(daemon, (signal.SIGINT, signal.SIGTERM))
