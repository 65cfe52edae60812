"""Anonymous memory that processes share by passing a file descriptor. It is freed with its last descriptor."""

import os
import tempfile


def nameless_file(label: str, size: int) -> int:
    """Return a descriptor of ``size`` zero bytes, in memory where the system has ``memfd_create``.

    It does not use /dev/shm, which is small in containers. ``label`` is the name that the system shows. Raises
    OSError.
    """
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create(label)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd
