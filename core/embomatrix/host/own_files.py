"""Files that a command may replace: those that this tool wrote, known by a mark in their first bytes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.host.failure import fail

HEAD_BYTES: Final = 4096
"""Bytes at the beginning of a file that are searched for its mark."""
PAGE_MARK: Final = b'<meta name="generator" content="EmboMatrix">'
"""Mark of HTML pages."""
PICTURE_MARK: Final = b"Software\0EmboMatrix"
"""Mark of pictures: a text chunk before the pixels of a PNG file, a comment in a JPEG file."""
Force = Annotated[bool, typer.Option("--force", help="Replace files there that this command did not write.")]
"""Option of commands that choose the names of the files that they write."""


def is_own(path: Path, *marks: bytes) -> bool:
    """Return True for a file with all marks in its first ``HEAD_BYTES``, False for any other or an unreadable one."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return bool(marks) and all(mark in head for mark in marks)


def keep_foreign(command: str, paths: Iterable[Path], *marks: bytes, force: bool = False) -> None:
    """Exit with status 2 if a path exists and is not a file with the marks. With ``force`` all may be replaced."""
    foreign = next((path for path in paths if not force and path.exists() and not is_own(path, *marks)), None)
    if foreign is not None:
        fail(
            command,
            f"{foreign} was not written by this command: name another place with --out, or pass --force to replace it",
        )
