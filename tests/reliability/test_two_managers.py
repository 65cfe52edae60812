"""A8: two managers on one Redis. The standby takes over with the full state."""

import asyncio
import signal
import time

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from tests.fakes.real_cluster import (
    RealCluster,
    batch_of,
    connected,
    opened,
    outcomes,
    print_figures,
    tally,
    until,
)
from tests.fakes.redis_server import RedisServer

from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import StandbyError

pytestmark = pytest.mark.timeout(240)


async def answers(cluster, name):
    """Return a manager's health status, or nothing while it changes from standby to leader."""
    async with grpc.aio.insecure_channel(f"127.0.0.1:{cluster.ports[name]}") as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        try:
            answer = await stub.Check(health_pb2.HealthCheckRequest(), wait_for_ready=True, timeout=30)
        except grpc.aio.AioRpcError:
            return ""
    return health_pb2.HealthCheckResponse.ServingStatus.Name(answer.status)


async def leads(cluster, name, status="SERVING"):
    """Wait until this manager leads, or has another status; returns how many seconds that took."""
    began_s = time.monotonic()
    async with asyncio.timeout(60):
        while await answers(cluster, name) != status:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
    return time.monotonic() - began_s


async def stands_by(cluster, name):
    """Wait until this manager is ready as standby."""
    await leads(cluster, name, "NOT_SERVING")


async def both(cluster):
    """Start a leader and a standby manager, and two workers that know both."""
    cluster.start_manager("first")
    await leads(cluster, "first")
    cluster.start_manager("second")
    for name in ("w1", "w2"):
        cluster.start_worker(name)


async def failed_over(folder, *, count, kill_at, ttl_s, number=signal.SIGKILL):
    with (
        RedisServer(folder / "redis", free_port()) as redis,
        RealCluster(folder, state=redis.url, leader_ttl_s=ttl_s, restart_grace_s=15.0) as cluster,
    ):
        await both(cluster)
        await stands_by(cluster, "second")
        async with cluster.client() as client:
            await connected(client, "w1", "w2")
            batch = batch_of(await opened(client), count, "slow")
            killed = asyncio.Event()

            def kill(seen):
                if seen == kill_at:
                    cluster.signal("first", number)
                    killed.set()

            running = asyncio.create_task(outcomes(client, batch, then=kill))
            await killed.wait()
            takeover_s = await leads(cluster, "second")
            joined_s = await connected(client, "w1", "w2")
            results = await running
        counted = tally(batch, results)
        again = sum(times - 1 for times in cluster.executed().values())
        print_figures(
            f"A8 {number.name}", counted, executed_again=again, takeover_s=takeover_s, rejoin_s=joined_s
        )
        assert counted.clean
        assert again == 0


async def test_standby_takes_over_when_the_leader_is_killed(tmp_path):
    await failed_over(tmp_path, count=10, kill_at=2, ttl_s=1.0)


@pytest.mark.slow
async def test_standby_takes_over_within_ten_seconds_by_default(tmp_path):
    await failed_over(tmp_path, count=10, kill_at=2, ttl_s=6.0)


@pytest.mark.slow
async def test_orderly_stopped_leader_hands_over_at_once(tmp_path):
    await failed_over(tmp_path, count=10, kill_at=2, ttl_s=30.0, number=signal.SIGTERM)


@pytest.mark.slow
async def test_frozen_leader_is_fenced_and_exits(tmp_path):
    with (
        RedisServer(tmp_path / "redis", free_port()) as redis,
        RealCluster(tmp_path, state=redis.url, leader_ttl_s=1.0) as cluster,
    ):
        await both(cluster)
        async with cluster.client() as client:
            await connected(client, "w1", "w2")
            batch = batch_of(await opened(client), 40, "slow")
            running = asyncio.create_task(outcomes(client, batch))
            await until(lambda: len(cluster.executed()) >= 8)
            cluster.signal("first", signal.SIGSTOP)
            takeover_s = await leads(cluster, "second")
            cluster.signal("first", signal.SIGCONT)
            ended = await asyncio.to_thread(cluster.processes["first"].wait, 30)
            results = await running
        counted = tally(batch, results)
        print_figures("A8 frozen", counted, takeover_s=takeover_s)
        assert ended != 0
        assert "another manager took over" in cluster.log("first")
        assert (counted.delivered, counted.duplicates, counted.fabricated) == (40, 0, 0)


@pytest.mark.slow
async def test_standby_names_the_leader(tmp_path):
    with RealCluster(tmp_path, leader_ttl_s=60.0) as cluster:
        cluster.start_manager("first")
        await leads(cluster, "first")
        cluster.start_manager("second")
        await stands_by(cluster, "second")
        async with ClusterClient(f"127.0.0.1:{cluster.ports['second']}") as client:
            with pytest.raises(StandbyError, match="stands by") as caught:
                await client.open_run("x")
        assert caught.value.leader == f"127.0.0.1:{cluster.ports['first']}"
        both_of_them = f"127.0.0.1:{cluster.ports['second']},127.0.0.1:{cluster.ports['first']}"
        async with ClusterClient(both_of_them) as client, AdminClient(both_of_them) as admin:
            assert await client.open_run("x", "x") == "x"
            assert [run.run_id for run in await admin.list_runs()] == ["x"]
