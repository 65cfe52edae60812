"""Measure something in a process of its own: what it prints, leaves running or never ends does not concern this one."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import psutil

from embomatrix.host.parent import die_with_parent

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection

TOLD_CHARS: Final = 300
GRACE_S: Final = 5.0


def apart(measure: Callable[..., Any], arguments: tuple[Any, ...], limit_s: float) -> Any:
    """What ``measure`` returns in a new process; a sentence when it fails, or is not done within ``limit_s`` seconds.

    Function, arguments and result must be picklable.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory(prefix="embo-") as folder:
        log = Path(folder) / "output.log"
        process = context.Process(target=_measure, args=(theirs, os.getpid(), log, measure, arguments))
        process.start()
        theirs.close()
        try:
            if not ours.poll(limit_s):
                return f"it was not done within {limit_s:g} s"
            return ours.recv()
        except EOFError:
            process.join(GRACE_S)
            return f"its process ended with status {process.exitcode}: {_end_of(log)}"
        finally:
            _end(process.pid or 0)
            process.join()
            ours.close()


def _measure(
    answer: Connection, parent: int, log: Path, measure: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    die_with_parent(parent)
    with log.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    try:
        result = measure(*arguments)
    except Exception as error:  # noqa: BLE001  # whatever a library raises, it is told and not raised on
        result = f"{type(error).__name__}: {error}"[:TOLD_CHARS]
    answer.send(result)
    answer.close()


def _end(pid: int) -> None:
    """Kill the process and what it started."""
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        for one in (*process.children(recursive=True), process):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()


def _end_of(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1][-TOLD_CHARS:] if lines else "it said nothing"
