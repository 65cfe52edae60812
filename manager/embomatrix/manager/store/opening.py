"""Selection of the state store by its URL, with timed operations."""

import inspect
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from embomatrix.manager.store.protocol import StateError, StateStore
from embomatrix.rpc.logs import without_secrets


def open_store(url: str) -> StateStore:
    """Open ``memory:``, ``sqlite:PATH`` or ``redis://HOST:PORT/DB``. Raises StateError."""
    # Imported here: a manager with a state file needs no Redis client.
    if url == "memory:" or (url.startswith("sqlite:") and len(url) > len("sqlite:")):
        from embomatrix.manager.store.sqlite import SqliteStore

        return SqliteStore("file::memory:" if url == "memory:" else Path(url[7:]).expanduser())
    if url.startswith(("redis://", "rediss://", "unix://")):
        from embomatrix.manager.store.redis import RedisStore

        return RedisStore(url)
    raise StateError(
        f"--state {without_secrets(url)!r}: expected memory:, sqlite:PATH or redis://HOST:PORT/DB"
    )


def timed_store(store: StateStore, on_done: Callable[[str, float], None]) -> StateStore:
    """Return the store with ``on_done(operation, seconds)`` called after each operation, even a failed one."""
    return cast("StateStore", _TimedStore(store, on_done))


class _TimedStore:
    """Wraps every coroutine function of a store."""

    def __init__(self, store: StateStore, on_done: Callable[[str, float], None]) -> None:
        self._store = store
        self._on_done = on_done

    def __getattr__(self, name: str) -> Any:
        operation = getattr(self._store, name)
        if not inspect.iscoroutinefunction(operation):
            return operation

        async def timed(*args: Any, **kwargs: Any) -> Any:
            began_s = time.monotonic()
            try:
                return await operation(*args, **kwargs)
            finally:
                self._on_done(name, time.monotonic() - began_s)

        self.__dict__[name] = timed
        return timed
