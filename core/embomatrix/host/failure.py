"""Failures of commands: one sentence on standard error and an exit status; tracebacks go to a log file."""

import contextlib
import errno
import logging
import os
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NoReturn

from rich.console import Console

from embomatrix.host.printable import printable

logger = logging.getLogger(__name__)

MENDABLE: Final = 2
"""Exit status of errors that the user can fix: an unchanged retry fails again."""
DEFECT: Final = 70
"""Exit status of internal errors."""
INTERRUPTED: Final = 130
_STORAGE: Final = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS))
"""File system errors that are no fault of the program."""
_FULL: Final = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG))


@contextlib.contextmanager
def shown(command: str) -> Iterator[None]:
    """Turn escaping exceptions into a message and an exit status, ``INTERRUPTED`` or ``DEFECT``.

    Commands report errors that the user can fix themselves, with status ``MENDABLE``. File system errors may come from any
    command and are handled here. The traceback of a defect is written to disk; ``EMBOMATRIX_DEBUG=1`` lets it through.
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
            fail(command, unwritable(error.filename or "a file", error))
        path = _keep(error)
        fail(
            command,
            f"this should not have happened: {type(error).__name__}: {error}\n"
            f"The details are in {path}; please report them.",
            DEFECT,
        )


def fail(command: str, sentence: str, status: int = MENDABLE) -> NoReturn:
    """Print the problem on standard error and exit with the status."""
    name = f"embomatrix {command}".strip()
    Console(stderr=True, soft_wrap=True).print(
        printable(f"{name}: {sentence}", lines=True), highlight=False, markup=False
    )
    raise SystemExit(status)


def unwritable(path: Path | str, error: OSError) -> str:
    """Return the sentence about a file or folder that can't be written: its path, the reason and the remedy."""
    reason, remedy = error.strerror or str(error), "name another path"
    blocker = _file_above(Path(path))
    if error.errno in _FULL:
        remedy = "free disk space, or name another path"
    elif error.errno in (errno.EACCES, errno.EPERM):
        remedy = "fix the permissions, or name another path"
    elif error.errno == errno.EROFS:
        remedy = "name a path on another file system"
    elif error.errno == errno.ENAMETOOLONG:
        remedy = "name a shorter path"
    elif blocker is not None:
        reason, remedy = os.strerror(errno.ENOTDIR), f"{blocker} is a file; name another path"
    return f"{path} can't be written ({reason}): {remedy}"


def _file_above(path: Path) -> Path | None:
    """Return the file that the path takes for a folder."""
    try:
        return next((folder for folder in path.parents if folder.exists() and not folder.is_dir()), None)
    except OSError:
        return None


def _is_silent_interrupt(leaving: SystemExit) -> bool:
    """True if typer turned Ctrl-C into an exit without a message."""
    return leaving.code == INTERRUPTED and isinstance(
        getattr(leaving.__context__, "__cause__", None), KeyboardInterrupt
    )


def _keep(error: BaseException) -> Path:
    handle, name = tempfile.mkstemp(prefix="embomatrix-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write("".join(traceback.format_exception(error)))
    return Path(name)
