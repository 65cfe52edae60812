"""Other `embomatrix` commands, run in the foreground of one that needs several of them."""

from __future__ import annotations

import os
import signal
import subprocess
from typing import TYPE_CHECKING, Final

from embomatrix.cli.failure import INTERRUPTED, fail
from embomatrix.cli.local_cluster import without_membership
from embomatrix.cli.supervisor import embomatrix_command
from embomatrix.host.parent import with_this_process

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.cli.local_cluster import LocalCluster

STOP_S: Final = 60.0
"""An interrupted command may take this long to write what it keeps."""


def run_command(command: str, problem: Callable[[], str], *arguments: str) -> None:
    """Run one `embomatrix` command for ``command``; its failure is ours, with its own message and status, or with one of ours
    where a signal left it none.

    It is stopped when there is a ``problem``. An interrupt is handed on to it once, whoever it was sent to, so that it can
    write what it keeps.
    """
    with subprocess.Popen(
        embomatrix_command(*arguments),
        start_new_session=True,
        preexec_fn=with_this_process(signal.SIGTERM),
        env=without_membership(os.environ),
    ) as child:
        try:
            while (status := _status_of(child)) is None:
                if sentence := problem():
                    child.send_signal(signal.SIGTERM)
                    fail(command, sentence)
        except KeyboardInterrupt:
            child.send_signal(signal.SIGINT)
            _end(child)
            raise SystemExit(INTERRUPTED) from None
    if status < 0:
        fail(command, _ended_by(-status, arguments[0]))
    if status:
        raise SystemExit(status)


def _ended_by(number: int, command: str) -> str:
    reason = ", as the system does when memory runs out" if number == signal.SIGKILL else ""
    return (
        f"`embomatrix {command}` was ended from outside by signal {number} ({signal.strsignal(number)}){reason}: "
        "what it had saved is kept, give the same command again"
    )


def cluster_problem(cluster: LocalCluster) -> str:
    """Why work on it can't go on: the manager is gone for good, or the last worker is. Empty while it can."""
    failed = cluster.supervisor.failed()
    if "manager" not in failed and not set(cluster.workers) <= set(failed):
        return ""
    name = "manager" if "manager" in failed else failed[0]
    log = cluster.supervisor.log_path(name)
    return f"the cluster can't work, {name} ended with: {cluster.supervisor.last_words(name)} (log: {log})"


def no_problem() -> str:
    """Of a command that needs no cluster of ours."""
    return ""


def _status_of(child: subprocess.Popen[bytes]) -> int | None:
    try:
        return child.wait(timeout=0.5)
    except subprocess.TimeoutExpired:
        return None


def _end(child: subprocess.Popen[bytes]) -> None:
    try:
        child.wait(timeout=STOP_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        child.kill()
