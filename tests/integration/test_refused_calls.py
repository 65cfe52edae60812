"""Memory of the manager after refused calls of any size, and the end of silent connections."""

import asyncio
import contextlib

import grpc
import psutil
import pytest
from tests.fakes.real_cluster import RealCluster, connected

from embomatrix.rpc.channel import CHANNEL_OPTIONS, SERVER_OPTIONS

SECRET = "operators-secret"
CALLS = 20
MEGABYTES = 24
"""Size of each message. Kept until a garbage collection, twenty of them take 480 MB."""
MOST_MB = 200.0


@pytest.mark.parametrize("token", ["", SECRET])
@pytest.mark.parametrize("method", ["RolloutService/Execute", "WorkerService/Register"])
async def test_large_messages_of_refused_calls_are_freed(tmp_path, token, method):
    with RealCluster(tmp_path, token=SECRET) as cluster:
        cluster.start_manager()
        async with cluster.client(token=SECRET) as client:
            await connected(client)
        process = psutil.Process(cluster.processes["manager"].pid)
        first = most = process.memory_info().rss
        metadata = (("authorization", f"Bearer {token}"),) if token else ()
        async with grpc.aio.insecure_channel(cluster.address, options=CHANNEL_OPTIONS) as channel:
            call = channel.unary_unary(f"/embomatrix.proto.v1.{method}")
            for _ in range(CALLS):
                with pytest.raises(grpc.aio.AioRpcError) as caught:
                    await call(b"x" * (MEGABYTES * 10**6), metadata=metadata)
                assert caught.value.code() in (
                    grpc.StatusCode.UNAUTHENTICATED,
                    grpc.StatusCode.INVALID_ARGUMENT,
                )
                most = max(most, process.memory_info().rss)
    assert (most - first) / 1e6 < MOST_MB


@pytest.mark.parametrize("token", ["", SECRET])
async def test_messages_that_are_no_protobuf_leave_no_line_in_the_log(tmp_path, token):
    """Two hundred calls and streams are refused by a status, without a traceback."""
    expected = grpc.StatusCode.INVALID_ARGUMENT if token else grpc.StatusCode.UNAUTHENTICATED
    metadata = (("authorization", f"Bearer {token}"),) if token else ()
    with RealCluster(tmp_path, token=SECRET) as cluster:
        cluster.start_manager()
        async with cluster.client(token=SECRET) as client:
            await connected(client)
        before = len(cluster.log("manager").splitlines())
        async with grpc.aio.insecure_channel(cluster.address) as channel:
            for _ in range(50):
                for name in ("WorkerService/Heartbeat", "RolloutService/OpenRun", "AdminService/GetRun"):
                    with pytest.raises(grpc.aio.AioRpcError) as caught:
                        await channel.unary_unary(f"/embomatrix.proto.v1.{name}")(
                            b"\xff\xff\xff", metadata=metadata
                        )
                    assert caught.value.code() is expected
                call = channel.stream_stream("/embomatrix.proto.v1.WorkerService/Session")(metadata=metadata)
                # A client that writes to a refused stream reports an error of its own instead of the status.
                if token:
                    await call.write(b"\xff\xff\xff")
                assert await call.code() is expected
        lines = cluster.log("manager").splitlines()[before:]
    assert lines == []


async def test_connection_that_never_speaks_is_closed():
    hasty = [
        (key, 500 if key == "grpc.server_handshake_timeout_ms" else value) for key, value in SERVER_OPTIONS
    ]
    server = grpc.aio.server(options=hasty)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(8)]
    try:
        async with asyncio.timeout(10):
            for reader, _ in silent:
                with contextlib.suppress(ConnectionError):
                    while await reader.read(1024):
                        pass
    finally:
        for _, writer in silent:
            writer.close()
        await server.stop(None)
