"""Client: one outcome per rollout across broken streams, and readable errors."""

import asyncio

import pytest
from tests.fakes.cluster import FakeCluster, serving

from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import (
    STATUS,
    ClusterError,
    DeadlineError,
    InternalError,
    InvalidRequestError,
    ManagerUnreachableError,
    NotSignedInError,
    PreconditionError,
)
from embomatrix.rpc.wire.values import Batch, Rollout

LIMITS = ClientLimits(call_s=5.0, retry_first_s=0.01, retry_longest_s=0.05)


def _batch(count):
    return Batch(
        "run-1", "b-1", 0, tuple(Rollout(f"r{i}", "g", "sha256:0", "task", (), 1) for i in range(count))
    )


async def _execute(cluster, count, *, deadline_s=10.0):
    async with serving(cluster) as address, ClusterClient(address, limits=LIMITS) as client:
        return [result.rollout_id async for result in client.execute(_batch(count), deadline_s=deadline_s)]


async def test_every_rollout_of_a_batch_has_one_result():
    assert await _execute(FakeCluster(), 50) == [f"r{i}" for i in range(50)]


async def test_empty_batch_ends_at_once():
    cluster = FakeCluster()
    assert await _execute(cluster, 0) == []
    assert cluster.submissions == 0


@pytest.mark.parametrize("break_streams", [False, True])
async def test_stream_that_ends_early_is_attached_again_after_its_cursor(break_streams):
    cluster = FakeCluster(results_per_stream=2, break_streams=break_streams)
    assert await _execute(cluster, 5) == ["r0", "r1", "r2", "r3", "r4"]
    assert cluster.submissions == 1
    assert cluster.attachments == [2, 4]


async def test_forgotten_batch_is_resubmitted_without_duplicate_results():
    cluster = FakeCluster(results_per_stream=2, forget_after=1)
    assert await _execute(cluster, 5) == ["r0", "r1", "r2", "r3", "r4"]
    assert cluster.submissions == 2


async def test_deadline_says_how_many_outcomes_are_missing():
    with pytest.raises(DeadlineError, match="batch b-1: 3 of 3 rollouts had no outcome"):
        await _execute(FakeCluster(results_per_stream=0), 3, deadline_s=0.3)


async def test_batch_waits_for_an_unreachable_manager_until_its_deadline():
    async with ClusterClient("127.0.0.1:1", limits=LIMITS) as client:
        with pytest.raises(DeadlineError, match="2 of 2 rollouts had no outcome"):
            [result async for result in client.execute(_batch(2), deadline_s=0.5)]


async def test_duplicate_rollout_is_refused_with_its_field():
    batch = _batch(1)
    twice = Batch(batch.run_id, batch.batch_id, 0, batch.rollouts * 2)
    async with serving(FakeCluster()) as address, ClusterClient(address, limits=LIMITS) as client:
        with pytest.raises(InvalidRequestError, match=r"rollouts\[1\].rollout_id"):
            [result async for result in client.execute(twice, deadline_s=5.0)]


async def test_absent_manager_is_named_with_the_remedy():
    async with ClusterClient("127.0.0.1:1", limits=LIMITS) as client:
        with pytest.raises(
            ManagerUnreachableError, match=r"no manager answers at 127\.0\.0\.1:1: start one with"
        ):
            await client.open_run("demo")


async def test_web_page_at_the_address_is_no_manager_that_may_come_back():
    async def answer(reader, writer):
        await reader.read(64)
        writer.write(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as page:
        address = f"127.0.0.1:{page.sockets[0].getsockname()[1]}"
        async with ClusterClient(address, limits=LIMITS) as client:
            with pytest.raises(PreconditionError, match=f"a web page answers at {address}"):
                await client.open_run("demo")


async def test_unknown_host_is_named():
    async with ClusterClient("no-such-host.invalid:50070", limits=LIMITS) as client:
        with pytest.raises(
            ManagerUnreachableError, match=r"the host of no-such-host\.invalid:50070 is unknown"
        ):
            await client.open_run("demo")


async def test_internal_errors_of_the_manager_stay_in_its_log():
    async with serving(FakeCluster()) as address, ClusterClient(address, limits=LIMITS) as client:
        with pytest.raises(InternalError, match="its log has the details") as caught:
            await client.close_run("run-1")
    assert "a defect" not in str(caught.value)


async def test_server_without_the_call_is_reported_as_no_manager():
    async with serving(FakeCluster()) as address, ClusterClient(address, limits=LIMITS) as client:
        with pytest.raises(PreconditionError, match="not a manager of this version"):
            await client.list_workers()


async def test_token_is_sent_with_every_kind_of_call():
    cluster = FakeCluster(token="secret")
    async with serving(cluster) as address, ClusterClient(address, "secret", limits=LIMITS) as client:
        assert await client.open_run("demo") == "run-1"
        assert await client.put_bundles({"sha256:1": b"x"}) == ("sha256:1",)
        assert len([result async for result in client.execute(_batch(3), deadline_s=5.0)]) == 3


async def test_wrong_token_is_refused_with_the_manager_s_sentence():
    async with (
        serving(FakeCluster(token="secret")) as address,
        ClusterClient(address, "x", limits=LIMITS) as client,
    ):
        with pytest.raises(NotSignedInError, match="no such token"):
            await client.open_run("demo")


async def test_only_missing_bundles_are_sent_and_large_ones_arrive_whole():
    cluster = FakeCluster(bundles={"sha256:1": b"kept"})
    large = bytes(range(256)) * 10_000
    async with serving(cluster) as address, ClusterClient(address, limits=LIMITS) as client:
        assert await client.put_bundles({"sha256:1": b"new", "sha256:2": large}) == ("sha256:2",)
    assert cluster.bundles == {"sha256:1": b"kept", "sha256:2": large}


def test_every_status_maps_to_one_error():
    assert len(set(STATUS.values())) == len(STATUS)
    assert all(issubclass(error, ClusterError) for error in STATUS)
