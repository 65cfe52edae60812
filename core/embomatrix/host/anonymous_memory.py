"""Memory that processes share by handing on a file descriptor: it has no name, and ends with its last user."""

from __future__ import annotations

import os
import tempfile


def nameless_file(label: str, size: int) -> int:
    """A descriptor of so many bytes of 0, in memory only where the system offers that.

    A container's /dev/shm, which is small, has no part in it. ``label`` is what the system shows. Raises OSError.
    """
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create(label)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd
