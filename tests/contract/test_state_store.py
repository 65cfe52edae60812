"""Contract of the state stores: in memory, SQLite, and a real Redis server."""

import asyncio
import contextlib
import dataclasses
import itertools
import resource
import sqlite3

import pytest
from redis.asyncio import Redis
from tests.fakes.redis_server import RedisServer

from embomatrix.cli.local_cluster import free_port
from embomatrix.manager.store.opening import open_store
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
from embomatrix.manager.store.redis import RedisStore
from embomatrix.manager.store.sqlite import CHECKPOINT_BYTES, SqliteStore


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory):
    with RedisServer(tmp_path_factory.mktemp("redis"), free_port()) as server:
        yield server.url


_prefixes = itertools.count()


@pytest.fixture(params=["memory", "sqlite", "redis"])
async def openings(request, tmp_path):
    """Return a function that opens the same state once more, as another manager process would."""
    opened = []
    prefix = f"test-{next(_prefixes)}"

    def open_again():
        match request.param:
            case "memory":
                store = SqliteStore(f"file:{prefix}?mode=memory&cache=shared")
            case "sqlite":
                store = SqliteStore(tmp_path / "state.sqlite")
            case _:
                store = RedisStore(request.getfixturevalue("redis_url"), prefix=prefix)
        opened.append(store)
        return store

    yield open_again
    for store in opened:
        await store.close()


@pytest.fixture
async def store(openings):
    store = openings()
    await store.claim(FIRST)
    return store


FIRST = Candidate("first", "host:1", ttl_s=60.0)
SECOND = Candidate("second", "host:2", ttl_s=60.0)
BATCH = BatchRow("r1", "b1", "digest", b"\x00payload\xff")


def rows(*cursors):
    return [ResultRow(cursor, f"rollout:{cursor}", bytes([cursor, 0, 255])) for cursor in cursors]


async def test_run_is_stored_until_it_is_closed(store):
    await store.open_run(RunRow("r1", "first", b"\x08\x01 terms"))
    await store.open_run(RunRow("r2", "second"))
    await store.open_run(RunRow("r1", "another name", b"others"))
    assert await store.runs() == [RunRow("r1", "first", b"\x08\x01 terms"), RunRow("r2", "second")]
    await store.close_run("r1")
    await store.close_run("never opened")
    assert await store.runs() == [RunRow("r2", "second")]


async def test_batch_is_put_once_under_an_open_run(store):
    assert await store.put_batch(BATCH) is PutOutcome.NO_RUN
    await store.open_run(RunRow("r1", ""))
    assert await store.put_batch(BATCH) is PutOutcome.CREATED
    assert await store.put_batch(BATCH) is PutOutcome.SAME
    assert await store.put_batch(BatchRow("r1", "b1", "other", b"")) is PutOutcome.CONFLICT
    assert await store.batches("r1") == [BATCH]


async def test_batches_are_returned_in_insertion_order(store):
    await store.open_run(RunRow("r1", ""))
    for name in ("b9", "b1", "b5"):
        await store.put_batch(BatchRow("r1", name, "d", b""))
    assert [batch.batch_id for batch in await store.batches("r1")] == ["b9", "b1", "b5"]


async def test_results_are_read_from_a_cursor_in_order(store):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    assert await store.append_results([BatchResults("r1", "b1", rows(1, 2))]) == 2
    assert await store.append_results([BatchResults("r1", "b1", rows(3, 4, 5))]) == 3
    assert await store.results_after("r1", "b1", 0, 100) == rows(1, 2, 3, 4, 5)
    assert await store.results_after("r1", "b1", 2, 2) == rows(3, 4)
    assert await store.results_after("r1", "b1", 5, 100) == []


async def test_first_result_of_each_rollout_counts(store):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    await store.append_results([BatchResults("r1", "b1", rows(1))])
    assert (
        await store.append_results([BatchResults("r1", "b1", [ResultRow(2, "rollout:1", b"late"), *rows(3)])])
        == 1
    )
    assert await store.results_after("r1", "b1", 0, 100) == rows(1, 3)


async def test_results_of_several_batches_are_written_together(store):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    await store.put_batch(BatchRow("r1", "b2", "d", b""))
    parts = [
        BatchResults("r1", "b1", rows(1, 2)),
        BatchResults("r1", "unknown", rows(1)),
        BatchResults("r1", "b2", rows(1, 2, 3)),
    ]
    assert await store.append_results(parts) == 5
    assert await store.results_after("r1", "b1", 0, 100) == rows(1, 2)
    assert await store.results_after("r1", "b2", 0, 100) == rows(1, 2, 3)


async def test_results_of_an_unknown_batch_are_dropped(store):
    await store.open_run(RunRow("r1", ""))
    assert await store.append_results([BatchResults("r1", "b1", rows(1))]) == 0
    assert await store.results_after("r1", "b1", 0, 100) == []


async def test_closing_a_run_deletes_its_batches_and_results(store):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    await store.append_results([BatchResults("r1", "b1", rows(1))])
    await store.close_run("r1")
    await store.open_run(RunRow("r1", ""))
    assert await store.batches("r1") == []
    assert await store.put_batch(BATCH) is PutOutcome.CREATED
    assert await store.results_after("r1", "b1", 0, 100) == []


async def test_closing_a_run_deletes_its_window_only(store):
    for run_id in ("r1", "r2"):
        await store.open_run(RunRow(run_id, ""))
    await store.put_rows(Namespace.WINDOWS, [NamespaceRow("r1", b"of r1"), NamespaceRow("r2", b"of r2")])
    await store.put_rows(Namespace.SWITCHES, [NamespaceRow("r1", b"on")])
    await store.close_run("r1")
    assert await store.rows(Namespace.WINDOWS) == [NamespaceRow("r2", b"of r2")]
    assert await store.rows(Namespace.SWITCHES) == [NamespaceRow("r1", b"on")]


async def test_dropped_batch_leaves_the_others(store):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    await store.put_batch(BatchRow("r1", "b2", "d", b""))
    await store.append_results([BatchResults("r1", "b2", rows(1))])
    await store.drop_batch("r1", "b1")
    assert [batch.batch_id for batch in await store.batches("r1")] == ["b2"]
    assert await store.results_after("r1", "b2", 0, 100) == rows(1)


async def test_list_of_workers_is_replaced_as_a_whole(store, openings):
    assert await store.workers() == frozenset()
    await store.put_workers(["w1", "w2"])
    await store.put_workers(["w2", "w3"])
    assert await openings().workers() == {"w2", "w3"}
    await store.put_workers([])
    assert await store.workers() == frozenset()


async def test_another_process_reads_the_same_state(store, openings):
    await store.open_run(RunRow("r1", "name"))
    await store.put_batch(BATCH)
    await store.append_results([BatchResults("r1", "b1", rows(1, 2))])
    again = openings()
    await again.claim(FIRST)
    assert await again.runs() == [RunRow("r1", "name")]
    assert await again.batches("r1") == [BATCH]
    assert await again.results_after("r1", "b1", 1, 100) == rows(2)


@pytest.mark.parametrize("shelf", Namespace)
async def test_named_rows_survive_reopening_and_the_latest_counts(store, openings, shelf):
    await store.put_rows(shelf, [NamespaceRow("a", b"\x00first"), NamespaceRow("b", b"of b")])
    await store.put_rows(shelf, [NamespaceRow("a", b"second\xff")])
    again = openings()
    found = await again.rows(shelf)
    assert sorted(found, key=lambda row: row.key) == [
        NamespaceRow("a", b"second\xff"),
        NamespaceRow("b", b"of b"),
    ]
    assert not any([await again.rows(other) for other in Namespace if other is not shelf])


async def test_one_manager_leads_and_the_other_learns_its_address(store, openings):
    other = openings()
    assert await other.claim(SECOND) == Lead(1, "host:1", mine=False)
    with pytest.raises(FencedError):
        await other.open_run(RunRow("r1", ""))
    await store.open_run(RunRow("r1", ""))


async def test_released_leader_lease_goes_to_the_next_manager(store, openings):
    other = openings()
    await store.close()
    assert await other.claim(SECOND) == Lead(2, "host:2", mine=True)


async def test_replaced_leader_does_not_release_the_new_lease(store, openings):
    newer, third = openings(), openings()
    await newer.claim(FIRST)
    await store.close()
    assert not (await third.claim(SECOND)).mine


async def test_leader_lease_lapses_without_renewal(openings):
    brief, other = openings(), openings()
    await brief.claim(dataclasses.replace(FIRST, ttl_s=0.4))
    for _ in range(3):
        await asyncio.sleep(0.2)
        await brief.renew()
        assert not (await other.claim(SECOND)).mine
    await asyncio.sleep(0.5)
    assert await other.claim(SECOND) == Lead(2, "host:2", mine=True)
    with pytest.raises(FencedError):
        await brief.renew()


async def test_unclaimed_lapsed_leader_lease_can_be_renewed(openings):
    store = openings()
    await store.claim(dataclasses.replace(FIRST, ttl_s=0.05))
    await asyncio.sleep(0.1)
    await store.open_run(RunRow("r1", ""))
    await store.renew()
    assert await store.runs() == [RunRow("r1", "")]


async def test_restarted_manager_reclaims_its_own_leader_lease(store, openings):
    again = openings()
    assert await again.claim(FIRST) == Lead(2, "host:1", mine=True)
    with pytest.raises(FencedError):
        await store.open_run(RunRow("r1", ""))


async def test_only_the_latest_leader_may_write(store, openings):
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    newer = openings()
    assert await newer.claim(FIRST) == Lead(2, "host:1", mine=True)
    for write in (
        store.open_run(RunRow("r2", "")),
        store.put_batch(BatchRow("r1", "b2", "d", b"")),
        store.append_results([BatchResults("r1", "b1", rows(1))]),
        store.drop_batch("r1", "b1"),
        store.close_run("r1"),
        store.put_rows(Namespace.CREDENTIALS, [NamespaceRow("a", b"")]),
        store.put_workers(["w1"]),
    ):
        with pytest.raises(FencedError, match="another manager"):
            await write
    assert await newer.append_results([BatchResults("r1", "b1", rows(1))]) == 1


async def test_store_that_cannot_be_used_says_what_to_do(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StateError, match="--state"):
        open_store(f"sqlite:{tmp_path}/file/state.sqlite")
    with pytest.raises(StateError, match="expected memory:"):
        open_store("postgres://x")
    unreachable = open_store("redis://127.0.0.1:1/0")
    with pytest.raises(StateError, match="can't be reached"):
        await unreachable.claim(FIRST)
    await unreachable.close()


@contextlib.contextmanager
def no_file_grows(limit=200_000):
    """Limit file sizes of this process to ``limit`` bytes, like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


async def test_full_disk_raises_and_keeps_earlier_data(tmp_path):
    store = SqliteStore(tmp_path / "state.sqlite")
    await store.claim(FIRST)
    await store.open_run(RunRow("r1", ""))
    await store.put_batch(BATCH)
    large = [ResultRow(2, "large", bytes(500_000))]
    with no_file_grows():
        await store.append_results([BatchResults("r1", "b1", rows(1))])
        with pytest.raises(StateFullError, match="make room on its disk"):
            await store.append_results([BatchResults("r1", "b1", large)])
    assert await store.results_after("r1", "b1", 0, 10) == rows(1)
    assert await store.append_results([BatchResults("r1", "b1", large)]) == 1
    await store.close()


async def test_automatic_rollback_keeps_its_own_error(tmp_path):
    store = SqliteStore(tmp_path / "state.sqlite")
    await store.claim(FIRST)
    other = sqlite3.connect(tmp_path / "state.sqlite", isolation_level=None)
    # SQLite rolls back like this on a full disk.
    other.execute("CREATE TRIGGER full BEFORE INSERT ON run BEGIN SELECT RAISE(ROLLBACK, 'no room'); END")
    with pytest.raises(StateError, match="no room"):
        await store.open_run(RunRow("r1", ""))
    other.execute("DROP TRIGGER full")
    await store.open_run(RunRow("r1", ""))
    assert [run.run_id for run in await store.runs()] == ["r1"]
    other.close()
    await store.close()


async def test_write_waits_while_another_process_writes_to_the_file(tmp_path):
    store = SqliteStore(tmp_path / "state.sqlite")
    await store.claim(FIRST)
    other = sqlite3.connect(tmp_path / "state.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    writing = asyncio.create_task(store.open_run(RunRow("r1", "")))
    await asyncio.sleep(0.05)
    assert not writing.done()
    other.execute("COMMIT")
    await writing
    assert [run.run_id for run in await store.runs()] == ["r1"]
    other.close()
    await store.close()


async def test_batch_is_kept_while_the_file_is_read_and_the_journal_is_emptied_later(tmp_path):
    store = SqliteStore(tmp_path / "state.sqlite")
    journal = tmp_path / "state.sqlite-wal"
    await store.claim(FIRST)
    await store.open_run(RunRow("r1", ""))
    reader = sqlite3.connect(tmp_path / "state.sqlite", isolation_level=None)
    reader.execute("BEGIN")
    reader.execute("SELECT * FROM run").fetchall()
    await fill(store)
    assert journal.stat().st_size > CHECKPOINT_BYTES
    reader.close()
    await store.put_batch(BatchRow("r1", "last", "d", b""))
    assert journal.stat().st_size < CHECKPOINT_BYTES
    assert len(await store.batches("r1")) == 101
    await store.close()


async def fill(store):
    for number in range(100):
        await store.put_batch(BatchRow("r1", f"b{number}", "d", bytes(100_000)))


async def test_full_redis_raises_and_evicts_nothing(tmp_path):
    with RedisServer(tmp_path, free_port(), maxmemory="3mb") as server:
        store = RedisStore(server.url)
        await store.claim(FIRST)
        await store.open_run(RunRow("r1", ""))
        with pytest.raises(StateFullError, match="raise its maxmemory"):
            await fill(store)
        assert await store.runs() == [RunRow("r1", "")]
        await store.close()


async def test_redis_that_evicts_is_refused_with_the_remedy(tmp_path):
    with RedisServer(
        tmp_path, free_port(), maxmemory="10mb", **{"maxmemory-policy": "allkeys-lru"}
    ) as server:
        store = RedisStore(server.url)
        with pytest.raises(StateError, match="set `maxmemory-policy noeviction`"):
            await store.claim(FIRST)
        await store.close()


@pytest.mark.parametrize("led_again", [False, True])
async def test_a_redis_server_that_lost_its_data_is_not_called_another_manager(tmp_path, led_again):
    """Another manager may lead the empty state already: its epoch is lower."""
    with RedisServer(tmp_path / "lost", free_port()) as server:
        store, other = RedisStore(server.url), RedisStore(server.url)
        await store.claim(FIRST)
        await store.claim(FIRST)
        eraser = Redis.from_url(server.url)
        await eraser.flushall()
        await eraser.aclose()
        if led_again:
            assert (await other.claim(SECOND)).mine
        with pytest.raises(FencedError, match="Redis lost its data") as caught:
            await store.open_run(RunRow("r1", "run"))
        assert "another manager" not in str(caught.value)
        await store.close()
        await other.close()
