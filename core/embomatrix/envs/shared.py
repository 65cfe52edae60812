"""Environments that all episodes of a process share, for adapters that play many of them at a time in one event loop."""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, TypeVar

from embomatrix.envs.opening import make_where_named
from embomatrix.envs.rules import EpisodeRules, rules_of

if TYPE_CHECKING:
    from embomatrix.envs.environment import Environment

T = TypeVar("T")
_WAITING: Final = ThreadPoolExecutor(256, "episodes")
"""Threads that wait for turns, one for each episode that is played at a time."""
_OPENING: Final = threading.Lock()


def shared_environment(dataset: str, split: str, visibility: str, calls: int) -> Environment:
    """Return the environment of all episodes with these settings in this process.

    Episodes are executed on the cluster that ``EMBOMATRIX_MANAGER`` names, else in this process. Raises what ``make`` raises.
    """
    with _OPENING:  # two threads would open two
        return _opened(dataset, split, visibility, calls)


@functools.cache
def _opened(dataset: str, split: str, visibility: str, calls: int) -> Environment:
    return make_where_named(dataset, split, rules_of(EpisodeRules(calls=calls), visibility))


async def in_thread(work: Callable[..., T], *arguments: Any) -> T:
    """Wait for work that waits for the simulation, without holding up the event loop."""
    return await asyncio.get_running_loop().run_in_executor(_WAITING, work, *arguments)
