"""A person never sees a traceback: what escapes a command becomes one sentence, the rest goes to a log file."""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from collections.abc import Iterator

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def shown() -> Iterator[None]:
    """Turn what escapes into an exit status: 130 for an interrupt, 70 for a defect of ours, whose trace is kept on disk.

    Errors that a person can mend are shown by the commands themselves, with exit status 2. ``EMBOMATRIX_DEBUG=1`` lets
    the exception through.
    """
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        raise SystemExit(130) from None
    except Exception as error:
        if os.environ.get("EMBOMATRIX_DEBUG"):
            raise
        path = _keep(error)
        Console(stderr=True).print(
            f"embomatrix: this should not have happened: {type(error).__name__}: {error}\n"
            f"The details are in {path}; please report them.",
            highlight=False,
            markup=False,
        )
        raise SystemExit(70) from error


def _keep(error: BaseException) -> Path:
    handle, name = tempfile.mkstemp(prefix="embomatrix-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write("".join(traceback.format_exception(error)))
    return Path(name)
