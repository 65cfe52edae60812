"""Whoever opens connections and says nothing: the port stays open to others, and lets go of them."""

import asyncio
import contextlib
import socket

import httpx
import pytest
import uvicorn

from embomatrix.manager.http_connections import BoundedConnections

pytestmark = pytest.mark.timeout(120)
MOST = 8


class Few(BoundedConnections):
    most = MOST
    silent_s = 0.5


class Patient(BoundedConnections):
    most = MOST
    silent_s = 60.0


async def answer(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"here"})


@contextlib.asynccontextmanager
async def serving(kind):
    """Yields the port of a server with connections of this kind."""
    server = uvicorn.Server(uvicorn.Config(answer, http=kind, lifespan="off", log_config=None))
    server.capture_signals = contextlib.nullcontext
    bound = socket.create_server(("127.0.0.1", 0))
    task = asyncio.create_task(server.serve(sockets=[bound]))
    try:
        yield bound.getsockname()[1]
    finally:
        server.should_exit = True
        await task


async def ended(reader):
    with contextlib.suppress(ConnectionError):
        return await reader.read() == b""
    return True


async def test_connections_beyond_the_bound_end_at_once_and_the_others_go_on():
    async with serving(Patient) as port:
        opened = []
        for _ in range(MOST):
            opened.append(await asyncio.open_connection("127.0.0.1", port))
            opened[-1][1].write(b"GET / HTTP/1.1\r\nhost: here\r\n\r\n")
            assert b"200" in await opened[-1][0].readline()
        more = [await asyncio.open_connection("127.0.0.1", port) for _ in range(3 * MOST)]
        assert await asyncio.gather(*(ended(reader) for reader, _ in more)) == [True] * len(more)
        for _, writer in [*opened, *more]:
            writer.close()


async def test_connections_that_say_nothing_or_never_end_their_request_make_room():
    async with serving(Few) as port:
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
        for _, writer in silent[::2]:
            writer.write(b"GET / HTTP/1.1\r\nhost: ")
        assert await asyncio.gather(*(ended(reader) for reader, _ in silent)) == [True] * MOST
        async with httpx.AsyncClient(trust_env=False) as http:
            assert (await http.get(f"http://127.0.0.1:{port}/")).text == "here"
        for _, writer in silent:
            writer.close()
