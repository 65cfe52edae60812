"""A store whose operations are timed."""

from __future__ import annotations

import inspect
import time
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.manager.store.protocol import StateStore


def timed_store(store: StateStore, took: Callable[[str, float], None]) -> StateStore:
    """The same store; ``took`` is told of each operation's name and how many seconds it took, also when it failed."""
    return cast("StateStore", _TimedStore(store, took))


class _TimedStore:
    """Every operation of a store is a coroutine function: whatever the protocol has, it has here, timed."""

    def __init__(self, store: StateStore, took: Callable[[str, float], None]) -> None:
        self._store = store
        self._took = took

    def __getattr__(self, name: str) -> Any:
        operation = getattr(self._store, name)
        if not inspect.iscoroutinefunction(operation):
            return operation

        async def timed(*args: Any, **kwargs: Any) -> Any:
            began_s = time.monotonic()
            try:
                return await operation(*args, **kwargs)
            finally:
                self._took(name, time.monotonic() - began_s)

        self.__dict__[name] = timed
        return timed
