"""A person never sees a traceback: what escapes a command becomes one sentence, the rest goes to a log file."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import tempfile
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from rich.console import Console

if TYPE_CHECKING:
    from collections.abc import Iterator

logger = logging.getLogger(__name__)

MENDABLE: Final = 2
"""Exit status for what a person can mend: trying again without a change gives the same."""
DEFECT: Final = 70
"""Exit status for what should not have happened."""
INTERRUPTED: Final = 130
_STORAGE: Final = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS))
"""What a file system refuses without any fault of the program."""


@contextlib.contextmanager
def shown(command: str) -> Iterator[None]:
    """Turn what escapes a command into an exit status and a sentence: ``INTERRUPTED`` or ``DEFECT``.

    Errors that a person can mend are shown by the commands themselves, with status ``MENDABLE``; those of the file system
    are shown here, since they may come from any of them. The trace of a defect is kept on disk; ``EMBOMATRIX_DEBUG=1`` lets
    the exception through.
    """
    try:
        yield
    except KeyboardInterrupt:
        fail(command, "interrupted", INTERRUPTED)
    except SystemExit as leaving:
        if _is_silent_interrupt(leaving):
            fail(command, "interrupted", INTERRUPTED)
        raise
    except Exception as error:
        if os.environ.get("EMBOMATRIX_DEBUG"):
            raise
        if isinstance(error, OSError) and error.errno in _STORAGE:
            where = f"{error.filename} can't be written" if error.filename else "a file can't be written"
            fail(
                command, f"{where} ({error.strerror}): make room or give rights there, or name another folder"
            )
        path = _keep(error)
        fail(
            command,
            f"this should not have happened: {type(error).__name__}: {error}\n"
            f"The details are in {path}; please report them.",
            DEFECT,
        )


def fail(command: str, sentence: str, status: int = MENDABLE) -> NoReturn:
    """Say what is wrong on standard error, and leave with the status."""
    name = f"embomatrix {command}".strip()
    Console(stderr=True, soft_wrap=True).print(f"{name}: {sentence}", highlight=False, markup=False)
    raise SystemExit(status)


def _is_silent_interrupt(leaving: SystemExit) -> bool:
    """Whether typer has turned an interrupt into an exit without a word; a command that caught it has said its own."""
    return leaving.code == INTERRUPTED and isinstance(
        getattr(leaving.__context__, "__cause__", None), KeyboardInterrupt
    )


def _keep(error: BaseException) -> Path:
    handle, name = tempfile.mkstemp(prefix="embomatrix-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write("".join(traceback.format_exception(error)))
    return Path(name)
