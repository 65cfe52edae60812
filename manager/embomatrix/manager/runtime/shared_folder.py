"""Managers that share a state share a data folder as well: bundles lie there. One that was given another is told.

A folder has a random name of its own, in a file; whoever leads notes it in the state.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
from typing import TYPE_CHECKING, Final

from embomatrix.manager.store.protocol import Shelf, ShelfRow

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.manager.store.protocol import StateStore

logger = logging.getLogger(__name__)

MARK: Final = "folder-id"
_KEY: Final = "data_folder"


async def warn_of_another_folder(store: StateStore, folder: Path) -> None:
    """Tell in the log when the manager that led last had another data folder than this one. Raises StateError, OSError."""
    noted = {row.key: row.payload for row in await store.rows(Shelf.SWITCHES)}.get(_KEY)
    if noted is not None and noted != _mark_of(folder):
        logger.warning(
            "the data folder %s is not that of the manager that led last on this state: bundles of its runs are missing "
            "here, and their rollouts would fail. Give all managers of a state one --data-dir, such as a network share",
            folder,
        )


async def note_folder(store: StateStore, folder: Path) -> None:
    """This manager leads, with this data folder. Raises StateError, OSError."""
    await store.put_rows(Shelf.SWITCHES, [ShelfRow(_KEY, _mark_of(folder))])


def _mark_of(folder: Path) -> bytes:
    """The folder's own name, which it gets when nobody asked before."""
    file = folder / MARK
    with contextlib.suppress(FileExistsError), file.open("xb") as made:
        made.write(secrets.token_hex(16).encode())
    return file.read_bytes()
