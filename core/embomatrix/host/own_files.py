"""Files that a command writes: their folders are made, and a file that this tool did not write is not replaced."""

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.host.failure import fail, unwritable

HEAD_BYTES: Final = 4096
"""Bytes at the beginning of a file that are searched for its mark."""
PAGE_MARK: Final = b'<meta name="generator" content="EmboMatrix">'
"""Mark of HTML pages."""
PICTURE_MARK: Final = b"Software\0EmboMatrix"
"""Mark of pictures: a text chunk before the pixels of a PNG file, a comment in a JPEG file."""
Force = Annotated[bool, typer.Option("--force", help="Replace files there that this command did not write.")]
"""Option of commands that choose the names of the files that they write."""


def prepare_output(command: str, *paths: Path | None) -> None:
    """Make the folders of the files that a command will write; None stands for a file that is not asked for.

    Call it before long work: it exits with status 2 if a file can't be written, and leaves no file behind.
    """
    for path in paths:
        if path is not None:
            try:
                _make_room(path)
            except OSError as error:
                fail(command, unwritable(path, error))


def _make_room(path: Path) -> None:
    """Make the folder of the file, and write and remove a file beside it. Raise OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        # A device or a pipe would be replaced by a file.
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    part = path.with_name(f"{path.name}.part")
    part.write_bytes(b"")
    part.unlink()


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
