"""Child processes that end with their parent."""

import ctypes
import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import Final

_PR_SET_PDEATHSIG: Final = 1


def with_this_process(by: signal.Signals = signal.SIGKILL) -> Callable[[], None] | None:
    """Return a ``preexec_fn`` for child processes that end with this one; None if the system cannot do that."""
    return functools.partial(die_with_parent, os.getpid(), by) if sys.platform == "linux" else None


def die_with_parent(parent: int, by: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send the signal ``by`` to this process when its parent, process id ``parent``, ends.

    On systems other than Linux only a parent that has ended already is noticed.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, by)
    if os.getppid() != parent:
        os._exit(1)
