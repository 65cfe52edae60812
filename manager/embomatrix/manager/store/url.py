"""Which store a state URL means."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from embomatrix.manager.store.protocol import StateError

if TYPE_CHECKING:
    from embomatrix.manager.store.protocol import StateStore


def without_password(url: str) -> str:
    """The URL as it may be shown: a password in it becomes ``***``."""
    return re.sub(r"(://[^/@:]*:)[^/@]*@", r"\1***@", url)


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
    raise StateError(
        f"--state {without_password(url)!r}: expected memory:, sqlite:PATH or redis://HOST:PORT/DB"
    )
