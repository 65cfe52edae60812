"""Atomic writes and bounded reads of files."""

import errno
import functools
import os
from pathlib import Path


def write_whole(path: Path, data: bytes, *, mode: int = 0o666) -> None:
    """Write beside the target and rename: readers see the old file or the new one. Raises OSError.

    The file has the permissions ``mode``, less the umask, from its first byte.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        part.unlink(missing_ok=True)
        with open(part, "xb", opener=functools.partial(os.open, mode=mode)) as file:
            file.write(data)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def read_whole(path: Path, *, at_most: int) -> bytes:
    """Read a file; at most ``at_most`` bytes are ever in memory. Raises OSError, with EFBIG for a larger file."""
    with path.open("rb") as file:
        data = file.read(at_most + 1)
    if len(data) > at_most:
        raise OSError(errno.EFBIG, f"it has over {at_most:,} bytes", str(path))
    return data
