"""Which store a state URL means."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from embomatrix.manager.store.protocol import StateError

if TYPE_CHECKING:
    from embomatrix.manager.store.protocol import StateStore


def open_store(url: str) -> StateStore:
    """The store for ``memory:``, ``sqlite:PATH`` or ``redis://HOST:PORT/DB``; ``StateError`` says what is wrong with it."""
    if url == "memory:":
        from embomatrix.manager.store.memory import MemoryStore

        return MemoryStore()
    if url.startswith("sqlite:") and len(url) > len("sqlite:"):
        from embomatrix.manager.store.sqlite import SqliteStore

        return SqliteStore(Path(url.removeprefix("sqlite:")).expanduser())
    if url.startswith(("redis://", "rediss://", "unix://")):
        # Imported here: who keeps the state in a file needs no Redis client.
        from embomatrix.manager.store.redis import RedisStore

        return RedisStore(url)
    raise StateError(f"{url!r} is no state: expected memory:, sqlite:PATH or redis://HOST:PORT/DB")
