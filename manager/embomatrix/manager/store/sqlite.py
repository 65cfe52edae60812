"""State store in one SQLite file, which survives a restart and needs no server, or in memory."""

import asyncio
import contextlib
import os
import sqlite3
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from embomatrix.manager.store.protocol import (
    BatchResults,
    BatchRow,
    Candidate,
    FencedError,
    Lead,
    Namespace,
    NamespaceRow,
    PutOutcome,
    ResultRow,
    RunRow,
    StateError,
    StateFullError,
)

T = TypeVar("T")

_FULL: Final = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE)
"""Error codes of a full disk or an exhausted quota."""
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_MAGIC: Final = b"SQLite format 3\x00"
_HEAD_BYTES: Final = 100
"""Bytes of the head of a state file: SQLite's file format, section 1.3."""
_JOURNAL_HEAD_BYTES: Final = 32
_FRAME_HEAD_BYTES: Final = 24
"""Bytes before the first frame of a journal, and before the page in each frame: section 4.1."""
_RESTORE: Final = "restore it from a backup, or move it away to start without its runs and tokens"

BUSY_S: Final = 5.0
"""Time that a transaction waits for another process that writes to the same file."""
BUSY_RETRY_S: Final = 0.005
BRIEF_BYTES: Final = 128 * 1024
"""Smaller transactions run on the event loop, since a thread switch takes longer. In WAL mode they write to the page cache;
only a checkpoint waits for the disk."""
CHECKPOINT_BYTES: Final = 4 * 1024 * 1024
"""Size of the journal at which it is copied into the file."""

_SCHEMA: Final = """
PRAGMA journal_mode = WAL;
PRAGMA synchronous = NORMAL;
PRAGMA wal_autocheckpoint = 0;
CREATE TABLE IF NOT EXISTS manager (only_row INTEGER PRIMARY KEY CHECK (only_row = 1), epoch INTEGER NOT NULL);
INSERT OR IGNORE INTO manager VALUES (1, 0);
CREATE TABLE IF NOT EXISTS run (run_id TEXT PRIMARY KEY, name TEXT NOT NULL, terms BLOB NOT NULL DEFAULT x'');
CREATE TABLE IF NOT EXISTS leader (
    only_row INTEGER PRIMARY KEY CHECK (only_row = 1), holder TEXT NOT NULL, address TEXT NOT NULL, until_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS batch (
    run_id TEXT NOT NULL, batch_id TEXT NOT NULL, digest TEXT NOT NULL, payload BLOB NOT NULL,
    PRIMARY KEY (run_id, batch_id)
);
CREATE TABLE IF NOT EXISTS result (
    run_id TEXT NOT NULL, batch_id TEXT NOT NULL, rollout_id TEXT NOT NULL, cursor INTEGER NOT NULL,
    payload BLOB NOT NULL, PRIMARY KEY (run_id, batch_id, rollout_id)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS worker (worker_id TEXT PRIMARY KEY) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS shelf (
    shelf TEXT NOT NULL, key TEXT NOT NULL, payload BLOB NOT NULL, PRIMARY KEY (shelf, key)
) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS result_order ON result (run_id, batch_id, cursor);
"""


class SqliteStore:
    """Store in a file, or in memory for a SQLite URI. Raises StateError if it cannot be opened.

    One connection, used by one thread at a time. Leader leases use wall-clock time, which all processes of this
    machine share.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = path
        self._journal = None if isinstance(path, str) else path.with_name(path.name + "-wal")
        self._epoch = 0
        self._candidate: Candidate | None = None
        self._lock = asyncio.Lock()
        try:
            if not isinstance(path, str):
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                # New journal files get the mode of the state file, which holds the key of lease ids.
                os.close(os.open(path, os.O_CREAT | os.O_RDWR, 0o600))
                for file in (path, path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-shm")):
                    with contextlib.suppress(FileNotFoundError):
                        file.chmod(0o600)
            self._db = sqlite3.connect(
                path, timeout=0.0, check_same_thread=False, isolation_level=None, uri=isinstance(path, str)
            )
            if not isinstance(path, str):
                _check_whole(path, path.with_name(f"{path.name}-wal"))
            self._retry_while_busy(lambda: self._db.executescript(_SCHEMA))
        except (sqlite3.Error, OSError) as error:
            raise StateError(
                f"the state file {path} can't be used ({error}): {_remedy(error)}, or pass --state"
            ) from error

    async def claim(self, candidate: Candidate) -> Lead:
        def claim() -> Lead:
            leader = self._db.execute("SELECT holder, address, until_s FROM leader").fetchone()
            if leader and leader[0] != candidate.holder and time.time() < leader[2]:
                return Lead(self._known_epoch(), leader[1], mine=False)
            self._db.execute("UPDATE manager SET epoch = epoch + 1")
            self._lead(candidate)
            return Lead(self._known_epoch(), candidate.address, mine=True)

        lead = await self._run(claim, fenced=False)
        if lead.mine:
            self._epoch, self._candidate = lead.epoch, candidate
        return lead

    async def renew(self) -> None:
        if (candidate := self._candidate) is not None:
            await self._run(lambda: self._lead(candidate))

    async def open_run(self, run: RunRow) -> None:
        await self._write("INSERT OR IGNORE INTO run VALUES (?, ?, ?)", run.run_id, run.name, run.terms)

    async def close_run(self, run_id: str) -> None:
        def delete() -> None:
            for table in ("result", "batch", "run"):
                self._db.execute(f"DELETE FROM {table} WHERE run_id = ?", (run_id,))
            self._db.execute(
                "DELETE FROM shelf WHERE shelf = ? AND key = ?", (Namespace.WINDOWS.value, run_id)
            )

        await self._run(delete)

    async def put_batch(self, batch: BatchRow) -> PutOutcome:
        def put() -> PutOutcome:
            if self._db.execute("SELECT 1 FROM run WHERE run_id = ?", (batch.run_id,)).fetchone() is None:
                return PutOutcome.NO_RUN
            row = (batch.run_id, batch.batch_id, batch.digest, batch.payload)
            if self._db.execute("INSERT OR IGNORE INTO batch VALUES (?, ?, ?, ?)", row).rowcount:
                return PutOutcome.CREATED
            known = self._db.execute("SELECT digest FROM batch WHERE run_id = ? AND batch_id = ?", row[:2])
            return PutOutcome.SAME if known.fetchone()[0] == batch.digest else PutOutcome.CONFLICT

        return await self._run(put, written=len(batch.payload))

    async def append_results(self, parts: Sequence[BatchResults]) -> int:
        written = sum(len(row.payload) for part in parts for row in part.rows)
        return await self._run(lambda: sum(self._append(part) for part in parts), written=written)

    def _append(self, part: BatchResults) -> int:
        key = (part.run_id, part.batch_id)
        batch = self._db.execute("SELECT 1 FROM batch WHERE run_id = ? AND batch_id = ?", key)
        if batch.fetchone() is None:
            return 0
        values = [(*key, row.rollout_id, row.cursor, row.payload) for row in part.rows]
        return self._db.executemany("INSERT OR IGNORE INTO result VALUES (?, ?, ?, ?, ?)", values).rowcount

    async def results_after(self, run_id: str, batch_id: str, cursor: int, limit: int) -> list[ResultRow]:
        query = (
            "SELECT cursor, rollout_id, payload FROM result "
            "WHERE run_id = ? AND batch_id = ? AND cursor > ? ORDER BY cursor LIMIT ?"
        )
        return [ResultRow(*row) for row in await self._read(query, run_id, batch_id, cursor, limit)]

    async def drop_batch(self, run_id: str, batch_id: str) -> None:
        def delete() -> None:
            for table in ("result", "batch"):
                query = f"DELETE FROM {table} WHERE run_id = ? AND batch_id = ?"
                self._db.execute(query, (run_id, batch_id))

        await self._run(delete)

    async def runs(self) -> list[RunRow]:
        return [
            RunRow(*row) for row in await self._read("SELECT run_id, name, terms FROM run ORDER BY rowid")
        ]

    async def batches(self, run_id: str) -> list[BatchRow]:
        query = "SELECT run_id, batch_id, digest, payload FROM batch WHERE run_id = ? ORDER BY rowid"
        return [BatchRow(*row) for row in await self._read(query, run_id)]

    async def put_workers(self, worker_ids: Collection[str]) -> None:
        def put() -> None:
            self._db.execute("DELETE FROM worker")
            rows = [(worker_id,) for worker_id in worker_ids]
            self._db.executemany("INSERT INTO worker VALUES (?)", rows)

        await self._run(put)

    async def workers(self) -> frozenset[str]:
        return frozenset(row[0] for row in await self._read("SELECT worker_id FROM worker"))

    async def put_rows(self, namespace: Namespace, rows: Sequence[NamespaceRow]) -> None:
        values = [(namespace.value, row.key, row.payload) for row in rows]
        await self._run(lambda: self._db.executemany("INSERT OR REPLACE INTO shelf VALUES (?, ?, ?)", values))

    async def rows(self, namespace: Namespace) -> list[NamespaceRow]:
        query = "SELECT key, payload FROM shelf WHERE shelf = ?"
        return [NamespaceRow(*row) for row in await self._read(query, namespace.value)]

    async def close(self) -> None:
        with contextlib.suppress(StateError):
            await self._write("DELETE FROM leader")
        async with self._lock:
            self._db.close()

    def _lead(self, candidate: Candidate) -> None:
        row = (candidate.holder, candidate.address, time.time() + candidate.ttl_s)
        self._db.execute("INSERT OR REPLACE INTO leader VALUES (1, ?, ?, ?)", row)

    def _known_epoch(self) -> int:
        return int(self._db.execute("SELECT epoch FROM manager").fetchone()[0])

    async def _write(self, query: str, *values: object) -> None:
        await self._run(lambda: self._db.execute(query, values))

    async def _read(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        return await self._run(lambda: self._db.execute(query, values).fetchall(), fenced=False)

    async def _run(self, work: Callable[[], T], *, fenced: bool = True, written: int = BRIEF_BYTES + 1) -> T:
        """Run the work in one transaction: on the event loop if it is small and the file is free, else on a thread.

        On a thread, a slow disk or another writing process does not delay heartbeats.
        """
        async with self._lock:
            try:
                if written <= BRIEF_BYTES and self._journal_bytes() < CHECKPOINT_BYTES:
                    try:
                        return self._transaction(work, fenced)
                    except sqlite3.OperationalError as error:
                        if not _is_busy(error):
                            raise
                return await self._on_thread(lambda: self._checkpointed(work, fenced))
            except sqlite3.Error as error:
                if getattr(error, "sqlite_errorcode", None) in _FULL:
                    raise StateFullError(
                        f"the state file {self._path} can't be written ({error}): make room on its disk"
                    ) from error
                raise StateError(
                    f"the state file {self._path} failed ({error}): {_remedy(error)}, or pass --state"
                ) from error

    async def _on_thread(self, work: Callable[[], T]) -> T:
        thread = asyncio.ensure_future(asyncio.to_thread(work))
        try:
            return await asyncio.shield(thread)
        except asyncio.CancelledError:
            # The thread still uses the connection: wait for it before the lock is released.
            await asyncio.wait([thread])
            raise

    def _checkpointed(self, work: Callable[[], T], fenced: bool) -> T:
        answer = self._retry_while_busy(lambda: self._transaction(work, fenced))
        if self._journal_bytes() >= CHECKPOINT_BYTES:
            # The data is safe in the journal. If a reader or a full disk blocks the checkpoint, the next transaction tries
            # again.
            with contextlib.suppress(sqlite3.Error):
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return answer

    def _journal_bytes(self) -> int:
        try:
            return self._journal.stat().st_size if self._journal else 0
        except FileNotFoundError:
            return 0

    def _retry_while_busy(self, work: Callable[[], T]) -> T:
        """Repeat the work while another process writes, for at most ``BUSY_S`` seconds."""
        ends_s = time.monotonic() + BUSY_S
        while True:
            try:
                return work()
            except sqlite3.OperationalError as error:
                if not _is_busy(error) or time.monotonic() >= ends_s:
                    raise
            time.sleep(BUSY_RETRY_S)

    def _transaction(self, work: Callable[[], T], fenced: bool) -> T:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            if fenced and self._known_epoch() != self._epoch:
                raise FencedError(f"another manager took over the state file {self._path}: stop this one")
            answer = work()
            self._db.execute("COMMIT")
        except BaseException:
            # On a full disk SQLite has rolled back already.
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise
        return answer


def _remedy(error: Exception) -> str:
    code = getattr(error, "sqlite_errorcode", 0)
    if code in _FULL:
        return "make room on its disk"
    return _RESTORE if code & 0xFF in _DAMAGED else "check its folder's permissions"


def _check_whole(path: Path, journal: Path) -> None:
    """Raise StateError if the file lacks pages that its head counts and the journal does not hold.

    SQLite reads a page that is cut off as zeros. It notices that in its trees, but not in long payloads.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    page_bytes, pages = int.from_bytes(head[16:18]), int.from_bytes(head[28:32])
    if not head.startswith(_MAGIC) or page_bytes < _HEAD_BYTES:
        return  # a new file, or one that SQLite refuses
    whole = path.stat().st_size // page_bytes
    lost = pages - whole
    if lost > 0:
        lost -= sum(whole < page <= pages for page in _pages_in(journal, page_bytes))
    if lost > 0:
        raise StateError(f"the state file {path} is damaged: it lacks {lost} of {pages} pages; {_RESTORE}")


def _pages_in(journal: Path, page_bytes: int) -> set[int]:
    """Return the numbers of the pages in the committed frames of a journal."""
    committed: set[int] = set()
    pending: set[int] = set()
    with contextlib.suppress(FileNotFoundError), journal.open("rb") as file:
        salts = file.read(_JOURNAL_HEAD_BYTES)[16:24]
        while len(frame := file.read(_FRAME_HEAD_BYTES + page_bytes)) == _FRAME_HEAD_BYTES + page_bytes:
            if frame[8:16] != salts:
                break  # frames of an earlier use of the file
            pending.add(int.from_bytes(frame[:4]))
            if int.from_bytes(frame[4:8]):  # the last frame of a transaction
                committed |= pending
                pending.clear()
    return committed


def _is_busy(error: sqlite3.OperationalError) -> bool:
    """Return True if another process writes. Extended error codes share the low byte."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY
