"""Processes that don't outlive the one that started them."""

from __future__ import annotations

import ctypes
import functools
import os
import signal
import sys
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_PR_SET_PDEATHSIG: Final = 1


def with_this_process(by: signal.Signals = signal.SIGKILL) -> Callable[[], None] | None:
    """The ``preexec_fn`` of a child process that is to end with this one; None where the system has no means for that."""
    return functools.partial(die_with_parent, os.getpid(), by) if sys.platform == "linux" else None


def die_with_parent(parent: int, by: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send ``by`` to this process when the one that started it, of the number ``parent``, ends, however that
    ends. On other systems than Linux only a parent that is gone already is noticed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, by)
    if os.getppid() != parent:
        os._exit(1)
