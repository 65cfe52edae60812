"""Ctrl-C, which is deferred while a policy is updated by half, and SIGTERM, which counts as Ctrl-C."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Any, Self


@contextlib.contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C within the block. Schedulers, containers and `timeout` end a program by it.

    A script's background processes begin with Ctrl-C ignored. Within the block they hear it, because an ignored one would
    swallow SIGTERM too. Has no effect outside the main thread, which alone receives signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ignores = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignores:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        if ignores:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


class DeferredInterrupts:
    """Context manager that holds back SIGINT from ``defer`` until its end. A second SIGINT takes effect at once.

    Has no effect outside the main thread, which alone receives signals.
    """

    def __init__(self) -> None:
        self._previous_handler: Any = None
        self._received = False

    def __enter__(self) -> Self:
        return self

    def defer(self) -> None:
        """Hold back SIGINT from now until the context ends."""
        if self._previous_handler is None and threading.current_thread() is threading.main_thread():
            self._previous_handler = signal.getsignal(signal.SIGINT)
            if self._previous_handler is not None:  # None: not a Python handler, so it could not be restored
                signal.signal(signal.SIGINT, self._on_interrupt)

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        self._received = True
        signal.signal(signal.SIGINT, self._previous_handler)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._previous_handler is not None:
            signal.signal(signal.SIGINT, self._previous_handler)
            self._previous_handler = None
        if self._received and error is None:
            signal.raise_signal(signal.SIGINT)
