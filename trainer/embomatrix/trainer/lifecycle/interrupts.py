"""Interrupts that wait until what was begun is whole: a policy that was moved by half can't be gone on from."""

from __future__ import annotations

import signal
import threading
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from types import FrameType, TracebackType


class Interrupts:
    """A context in which an interrupt is put off from ``put_off`` to the end, where it comes. A second one is not put off.

    Threads other than the main one know no interrupts.
    """

    def __init__(self) -> None:
        self._before: Any = None
        self._came = False

    def __enter__(self) -> Self:
        return self

    def put_off(self) -> None:
        """What follows, to the end of the context, is done as a whole."""
        if self._before is None and threading.current_thread() is threading.main_thread():
            self._before = signal.getsignal(signal.SIGINT)
            if self._before is not None:  # else a handler that is not Python's, and can't be put back
                signal.signal(signal.SIGINT, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._came = True
        signal.signal(signal.SIGINT, self._before)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None
        if self._came and error is None:
            signal.raise_signal(signal.SIGINT)
