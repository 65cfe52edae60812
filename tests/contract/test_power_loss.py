"""State stores after a power loss, which cuts their files at any byte.

A store that is started again holds exactly the first of its transactions, or refuses with a sentence that names the file and
the remedy.
"""

import asyncio
import contextlib
import random
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from tests.fakes.redis_server import RedisServer

from embomatrix.cli.local_cluster import free_port
from embomatrix.manager.store.protocol import (
    BatchResults,
    BatchRow,
    Candidate,
    Namespace,
    NamespaceRow,
    ResultRow,
    RunRow,
    StateError,
)
from embomatrix.manager.store.redis import RedisStore
from embomatrix.manager.store.sqlite import SqliteStore

FIRST = Candidate("first", "host:1", ttl_s=600.0)
LONG = 9_000
"""Bytes of a payload that needs several pages."""


def results(*cursors, size=40):
    rows = [ResultRow(cursor, f"r{cursor}", bytes([cursor]) * size) for cursor in cursors]
    return [BatchResults("run-1", "b1", rows)]


TRANSACTIONS = (
    lambda store: store.put_rows(Namespace.SWITCHES, [NamespaceRow("lease_key", b"k" * 32)]),
    lambda store: store.put_rows(
        Namespace.CREDENTIALS, [NamespaceRow("t1", b"{}"), NamespaceRow("t2", b"{}")]
    ),
    lambda store: store.open_run(RunRow("run-1", "a run", b"terms")),
    lambda store: store.put_batch(BatchRow("run-1", "b1", "d1", b"p" * LONG)),
    lambda store: store.put_workers(["w1", "w2"]),
    lambda store: store.append_results(results(1, 2)),
    lambda store: store.append_results(results(3, size=LONG)),
    lambda store: store.put_rows(Namespace.WINDOWS, [NamespaceRow("run-1", b"window")]),
    lambda store: store.open_run(RunRow("run-2", "")),
    lambda store: store.put_batch(BatchRow("run-2", "b1", "d2", b"q")),
    lambda store: store.append_results(results(4, 5, 6)),
    lambda store: store.put_workers(["w2"]),
    lambda store: store.drop_batch("run-1", "b1"),
    lambda store: store.put_batch(BatchRow("run-1", "b2", "d3", b"s" * LONG)),
    lambda store: store.drop_batch("run-2", "b1"),
    lambda store: store.close_run("run-2"),
    lambda store: store.put_rows(Namespace.REPUTATIONS, [NamespaceRow("w2", b"{}")]),
)
"""Atomic changes of the state. In Redis the batches of a closed run are dropped one by one, so none is left here."""


async def content_of(store):
    """Return everything in a store but its leader and epoch."""
    runs = await store.runs()
    batches = {run.run_id: await store.batches(run.run_id) for run in runs}
    rows = {
        (run_id, batch.batch_id): await store.results_after(run_id, batch.batch_id, 0, 100)
        for run_id, found in batches.items()
        for batch in found
    }
    shelves = {shelf: sorted(await store.rows(shelf), key=lambda row: row.key) for shelf in Namespace}
    return runs, batches, rows, await store.workers(), shelves


@contextlib.contextmanager
def damaged(original, folder, name, change):
    """Copy a folder, replace the bytes of one of its files by ``change(bytes)``, and yield the copy."""
    shutil.copytree(original, folder)
    path = folder / name
    path.write_bytes(change(path.read_bytes()))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def number_of(found, contents):
    """Return the number of transactions that the content holds; fail for a mix of several."""
    assert found in contents, found
    return max(number for number, content in enumerate(contents) if content == found)


# SQLite

STATE, JOURNAL = "state.sqlite", "state.sqlite-wal"
PAGE = 4096
SECTOR = 512


@dataclass(frozen=True)
class Lost:
    """Files of a store as a power loss left them, its content after each transaction, and then the journal's size."""

    folder: Path
    contents: list
    sizes: list

    def whole_in(self, size):
        """Return the number of transactions in the first bytes of the journal; -1 if the tables themselves are not."""
        return max((number for number, end in enumerate(self.sizes) if end <= size), default=-1)


def made(folder, checkpoints=()):
    """Make the transactions, copy the journal into the file after some of them, and keep the files of a running store."""
    live, lost = folder / "live", folder / "lost"
    live.mkdir()
    contents, sizes = [], []

    async def note(store):
        contents.append(await content_of(store))
        sizes.append((live / JOURNAL).stat().st_size)

    async def make():
        store = SqliteStore(live / STATE)
        await store.claim(FIRST)
        await note(store)
        for number, transaction in enumerate(TRANSACTIONS, 1):
            await transaction(store)
            if number in checkpoints:
                store._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            await note(store)
        shutil.copytree(live, lost, ignore=shutil.ignore_patterns("*-shm"))
        await store.close()

    asyncio.run(make())
    return Lost(lost, contents, sizes)


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Return stores with all transactions in the journal, nine of them in the file, and all of them in the file."""
    return {
        "journal": made(tmp_path_factory.mktemp("journal")),
        "both": made(tmp_path_factory.mktemp("both"), checkpoints=(9,)),
        "file": made(tmp_path_factory.mktemp("file"), checkpoints=(9, len(TRANSACTIONS))),
    }


@pytest.fixture
def in_journal(stores):
    return stores["journal"]


@pytest.fixture
def in_both(stores):
    return stores["both"]


@pytest.fixture
def in_file(stores):
    return stores["file"]


async def opened(folder):
    """Return the content of the SQLite store in this folder, or the sentence with which it refuses."""
    try:
        store = SqliteStore(folder / STATE)
        try:
            return await content_of(store)
        finally:
            store._db.close()
    except StateError as error:
        return str(error)


def check_sentence(sentence, folder):
    assert str(folder / STATE) in sentence
    assert "restore it from a backup, or move it away" in sentence
    assert "\n" not in sentence


def ends(sizes):
    """Return the offsets at and beside the end of each transaction."""
    return sorted({max(0, end + step) for end in sizes for step in (-1, 0, 1)})


async def check_cut_journal(lost, tmp_path, offsets):
    for size in offsets:
        with damaged(lost.folder, tmp_path / "cut", JOURNAL, lambda data, end=size: data[:end]) as folder:
            found = await opened(folder)
        whole = lost.whole_in(size)
        if whole >= 0:
            assert number_of(found, lost.contents) == number_of(lost.contents[whole], lost.contents), size
        else:
            assert found == lost.contents[0], size  # a new store, without any transaction


async def test_journal_cut_at_any_byte_holds_the_transactions_before(in_journal, tmp_path):
    rng = random.Random(3)
    anywhere = [rng.randrange(in_journal.sizes[-1]) for _ in range(40)]
    await check_cut_journal(in_journal, tmp_path, [*ends(in_journal.sizes)[:-1], *anywhere])


@pytest.mark.slow
@pytest.mark.timeout(1800)
async def test_journal_cut_at_every_byte_of_its_last_transactions_holds_those_before(in_journal, tmp_path):
    sizes = in_journal.sizes
    await check_cut_journal(in_journal, tmp_path, range(sizes[-4], sizes[-1]))
    await check_cut_journal(in_journal, tmp_path, range(0, sizes[-4], 37))


def without_sector(start, data):
    return data[:start] + bytes(len(data[start : start + SECTOR])) + data[start + SECTOR :]


async def check_lost_sector(lost, tmp_path, starts):
    for start in starts:
        with damaged(lost.folder, tmp_path / "cut", JOURNAL, partial(without_sector, start)) as folder:
            found = await opened(folder)
        whole = max(lost.whole_in(start), 0)
        assert number_of(found, lost.contents) >= number_of(lost.contents[whole], lost.contents), start


async def test_journal_with_a_lost_sector_holds_the_transactions_before_it(in_journal, tmp_path):
    rng = random.Random(4)
    size = in_journal.sizes[-1]
    await check_lost_sector(in_journal, tmp_path, [rng.randrange(0, size, SECTOR) for _ in range(40)])


@pytest.mark.slow
@pytest.mark.timeout(1800)
async def test_journal_with_any_sector_lost_holds_the_transactions_before_it(in_journal, tmp_path):
    await check_lost_sector(in_journal, tmp_path, range(0, in_journal.sizes[-1], SECTOR))


async def check_cut_file(lost, tmp_path, offsets):
    refused = 0
    for size in offsets:
        with damaged(lost.folder, tmp_path / "cut", STATE, lambda data, end=size: data[:end]) as folder:
            found = await opened(folder)
            if isinstance(found, str):
                check_sentence(found, folder)
                refused += 1
            else:
                assert number_of(found, lost.contents) in (0, len(TRANSACTIONS)), size
    return refused


@pytest.mark.parametrize("place", ["journal", "both", "file"])
async def test_state_file_cut_at_any_byte_is_whole_or_refused_with_the_remedy(place, stores, tmp_path):
    lost = stores[place]
    size = (lost.folder / STATE).stat().st_size
    rng = random.Random(5)
    offsets = [0, 1, 99, 100, *range(PAGE - 1, size, PAGE), *range(PAGE + 1, size, PAGE)]
    refused = await check_cut_file(lost, tmp_path, [*offsets, *(rng.randrange(size) for _ in range(20))])
    assert refused or place == "journal"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("place", ["journal", "both", "file"])
async def test_state_file_cut_at_every_byte_of_its_last_pages_is_whole_or_refused(place, stores, tmp_path):
    lost = stores[place]
    size = (lost.folder / STATE).stat().st_size
    await check_cut_file(lost, tmp_path, range(max(0, size - 2 * PAGE), size))
    await check_cut_file(lost, tmp_path, range(0, size, 53))


async def check_interrupted_checkpoint(in_both, tmp_path, choices):
    """Copy only some pages of the journal into the file, as a power loss in the middle of a checkpoint does."""
    folder = tmp_path / "after"
    shutil.copytree(in_both.folder, folder)
    db = sqlite3.connect(folder / STATE)
    db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    after = (folder / STATE).read_bytes()
    db.close()
    before = (in_both.folder / STATE).read_bytes()
    pages = range(max(len(before), len(after)) // PAGE)
    for written in choices(len(pages)):
        mixed = [(after if page in written else before)[page * PAGE : (page + 1) * PAGE] for page in pages]
        while mixed and not mixed[-1]:
            mixed.pop()  # the file has not grown yet
        content = b"".join(page or bytes(PAGE) for page in mixed)
        with damaged(in_both.folder, tmp_path / "cut", STATE, lambda _, new=content: new) as cut:
            found = await opened(cut)
        assert not isinstance(found, str), found
        assert number_of(found, in_both.contents) == len(TRANSACTIONS)


async def test_checkpoint_interrupted_after_any_pages_loses_nothing(in_both, tmp_path):
    rng = random.Random(6)

    def choices(pages):
        yield from (set(range(count)) for count in range(pages + 1))
        yield from ({page for page in range(pages) if rng.random() < 0.5} for _ in range(40))

    await check_interrupted_checkpoint(in_both, tmp_path, choices)


async def test_state_file_that_is_another_file_is_refused_with_the_remedy(in_file, tmp_path):
    for content in (b"\x00" * 8192, b"x" * 5000, bytes(range(256)) * 32):
        with damaged(in_file.folder, tmp_path / "cut", STATE, lambda _, new=content: new) as folder:
            check_sentence(await opened(folder), folder)


async def test_command_refuses_a_cut_state_file_in_one_sentence(in_file, tmp_path):
    with damaged(in_file.folder, tmp_path / "cut", STATE, lambda data: data[:-PAGE]) as folder:
        command = (sys.executable, "-m", "embomatrix.cli", "manager", "serve", "--port=0", "--http-port=0")
        options = (f"--state=sqlite:{folder / STATE}", f"--data-dir={tmp_path / 'data'}")
        ended = await asyncio.to_thread(
            subprocess.run, [*command, *options], capture_output=True, text=True, timeout=60, check=False
        )
    assert ended.returncode == 2
    check_sentence(ended.stderr.strip(), folder)


# Redis


async def redis_history(folder):
    """Make the transactions in a Redis that writes each to its file at once; return the contents after each."""
    server = RedisServer(folder, free_port(), appendfsync="always")
    contents = []
    with server:
        store = RedisStore(server.url)
        await store.claim(FIRST)
        contents.append(await content_of(store))
        for transaction in TRANSACTIONS:
            await transaction(store)
            contents.append(await content_of(store))
        await store.renew()
        await store._redis.aclose()
    return contents, next(folder.rglob("*.aof"))


@pytest.fixture(scope="module")
def aof(tmp_path_factory):
    folder = tmp_path_factory.mktemp("redis") / "live"
    return asyncio.run(redis_history(folder))


async def check_cut_aof(aof, tmp_path, offsets):
    contents, path = aof
    data, numbers, port = path.read_bytes(), [], free_port()
    for size in offsets(len(data)):
        folder = tmp_path / f"cut-{size}"
        folder.mkdir()
        (folder / path.name).write_bytes(data[:size])
        with RedisServer(folder, port) as server:
            store = RedisStore(server.url)
            numbers.append(number_of(await content_of(store), contents))
            assert (await store.claim(FIRST)).mine
            await store.close()
        shutil.rmtree(folder)
    return numbers


async def test_append_only_file_cut_at_any_byte_holds_the_transactions_before(aof, tmp_path):
    rng = random.Random(7)
    numbers = await check_cut_aof(
        aof, tmp_path, lambda size: sorted({0, size - 1, *(rng.randrange(size) for _ in range(12))})
    )
    assert numbers == sorted(numbers)
    assert numbers[0] == 0
    assert len(set(numbers)) > 4


@pytest.mark.slow
@pytest.mark.timeout(3600)
async def test_append_only_file_cut_at_every_byte_of_its_tail_holds_the_transactions_before(aof, tmp_path):
    numbers = await check_cut_aof(
        aof, tmp_path, lambda size: [*range(0, size - 2_000, 61), *range(size - 2_000, size)]
    )
    assert numbers == sorted(numbers)
    assert numbers[-1] == len(TRANSACTIONS)
