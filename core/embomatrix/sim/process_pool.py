"""Processes that share work, and end with the one that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any

from embomatrix.sim.zygote import die_with_parent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@contextlib.contextmanager
def process_pool(
    count: int, begin: Callable[..., None] | None = None, *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """So many processes at most, for as long as this is held; what nobody took up by then is dropped.

    Each calls ``begin(*arguments)`` first. They inherit nothing that this process's libraries hold, leave an interrupt to it,
    and don't outlive it when it is killed, on Linux.
    """
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, spawn, _begin, (os.getpid(), begin, arguments))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(parent: int, begin: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(parent)
    if begin is not None:
        begin(*arguments)
