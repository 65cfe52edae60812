"""Pools of worker processes that end with their parent."""

import contextlib
import functools
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from embomatrix.host.parent import die_with_parent


class Closes(Protocol):
    def close(self) -> object: ...


M = TypeVar("M", bound=Closes)
T = TypeVar("T")
R = TypeVar("R")


@contextlib.contextmanager
def process_pool(
    count: int, begin: Callable[..., None] | None = None, *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """Process pool of at most ``count`` processes; leaving the context drops queued work.

    Each process first calls ``begin(*arguments)``. Processes are spawned, ignore Ctrl-C (the parent handles it) and, on Linux,
    die with the parent.
    """
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, spawn, _begin, (os.getpid(), begin, arguments))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def shared_work(
    jobs: int, begin: Callable[..., M], work: Callable[[M, T], R], *arguments: Any, died: Exception
) -> Iterator[Callable[[Iterable[T]], Iterator[R]]]:
    """Context with an ordered map over items, in this process or in ``jobs`` processes.

    Each process calls ``begin(*arguments)`` once, then ``work(resource, item)`` per item. In this process the resource is
    closed at the end. Reading results raises ``died`` if a process of the pool dies.
    """
    if jobs == 1:
        with contextlib.closing(begin(*arguments)) as maker:
            yield functools.partial(map, functools.partial(work, maker))
        return
    with process_pool(jobs, _take_up, begin, arguments) as pool:
        yield functools.partial(_results, pool, functools.partial(_work, work), died)


def _results(
    pool: ProcessPoolExecutor, work: Callable[[T], R], died: Exception, items: Iterable[T]
) -> Iterator[R]:
    try:
        yield from pool.map(work, items)
    except BrokenProcessPool as error:
        raise died from error


_maker: Any
"""Resource of this pool process."""


def _take_up(begin: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    global _maker
    _maker = begin(*arguments)


def _work(work: Callable[[Any, T], R], item: T) -> R:
    return work(_maker, item)


def _begin(parent: int, begin: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(parent)
    if begin is not None:
        begin(*arguments)
