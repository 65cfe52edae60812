"""Ends of runs: the store may fail for a moment, and a run may be opened again while it ends."""

import asyncio

import pytest
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import batch, manager, open_run, outcomes

from embomatrix.manager.store.protocol import StateError
from embomatrix.manager.store.sqlite import SqliteStore
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import NotFoundError, UnavailableError

pytestmark = pytest.mark.timeout(60)


async def test_close_is_repeated_after_the_store_was_away(tmp_path, monkeypatch):
    close, calls = SqliteStore.close_run, []

    async def fail_once(store, run_id):
        calls.append(run_id)
        if len(calls) == 1:
            raise StateError("the disk is away")
        await close(store, run_id)

    monkeypatch.setattr(SqliteStore, "close_run", fail_once)
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2),
    ):
        await outcomes(client, batch(3))
        with pytest.raises(UnavailableError, match="the disk is away"):
            await client.close_run("r1")
        assert (await client.close_run("r1")).delivered == 3
        with pytest.raises(NotFoundError):
            await client.close_run("r1")
    assert calls == ["r1", "r1"]


async def test_run_that_is_opened_anew_while_it_ends_is_kept(tmp_path, monkeypatch):
    close, ending, may_end = SqliteStore.close_run, asyncio.Event(), asyncio.Event()
    order = []

    async def slowly(store, run_id):
        ending.set()
        await may_end.wait()
        await close(store, run_id)
        order.append("closed")

    opening = SqliteStore.open_run

    async def opened(store, run):
        order.append("opened")
        await opening(store, run)

    monkeypatch.setattr(SqliteStore, "close_run", slowly)
    monkeypatch.setattr(SqliteStore, "open_run", opened)
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        await client.open_run("first", "r1")
        closing = asyncio.create_task(client.close_run("r1"))
        await ending.wait()
        again = asyncio.create_task(client.open_run("second", "r1"))
        await asyncio.sleep(0.2)
        assert not again.done()
        may_end.set()
        await closing
        assert await again == "r1"
    assert order == ["opened", "closed", "opened"]
