"""Permissions of the files in which a manager keeps its state."""

import asyncio
import os
import stat
from pathlib import Path

import pytest

from embomatrix.manager.store.protocol import Candidate
from embomatrix.manager.store.sqlite import SqliteStore


@pytest.fixture(autouse=True)
def _permissive() -> object:
    """A umask that removes nothing."""
    before = os.umask(0)
    yield
    os.umask(before)


def test_the_state_file_and_its_journals_are_readable_by_their_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "new" / "state.sqlite"
    store = SqliteStore(path)
    asyncio.run(store.claim(Candidate("holder", "127.0.0.1:1", ttl_s=10.0)))
    modes = {file.name: stat.S_IMODE(file.stat().st_mode) for file in path.parent.iterdir()}
    assert modes == dict.fromkeys(("state.sqlite", "state.sqlite-wal", "state.sqlite-shm"), 0o600)
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def test_a_readable_state_file_of_a_former_version_becomes_private(tmp_path: Path) -> None:
    path = tmp_path / "state.sqlite"
    path.touch(0o644)
    SqliteStore(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
