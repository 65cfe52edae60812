"""Connection floods: silent clients are bounded and do not block others."""

import asyncio
import contextlib
import socket
import ssl

import httpx
import pytest
import uvicorn

from embomatrix.manager.access.folder import prepare
from embomatrix.manager.web.connections import BoundedConnections, BoundedListener, connections_of

pytestmark = pytest.mark.timeout(120)
MOST = 8


class Few(BoundedConnections):
    limit = MOST
    silent_s = 0.5


class Patient(BoundedConnections):
    limit = MOST
    silent_s = 60.0


class FairListener(BoundedListener):
    limit = 4 * MOST
    per_address = MOST
    handshake_s = 60.0


class HastyListener(BoundedListener):
    limit = MOST
    handshake_s = 0.5


class PatientListener(BoundedListener):
    limit = MOST
    handshake_s = 60.0


async def answer(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"here"})


@contextlib.asynccontextmanager
async def serving(kind, bound=None, **options):
    """Yield the port of a server with this kind of connections."""
    server = uvicorn.Server(uvicorn.Config(answer, http=kind, lifespan="off", log_config=None, **options))
    server.capture_signals = contextlib.nullcontext
    bound = bound or socket.create_server(("127.0.0.1", 0))
    task = asyncio.create_task(server.serve(sockets=[bound]))
    try:
        yield bound.getsockname()[1]
    finally:
        server.should_exit = True
        await task


@contextlib.asynccontextmanager
async def serving_by_tls(kind, folder):
    """Yield the port of such a server behind this kind of TLS listener, and the client's trust settings."""
    prepare(folder, sans=())
    access = folder / "access"
    files = {"ssl_certfile": access / "server.pem", "ssl_keyfile": access / "server.key"}
    listener = kind(socket.AF_INET, socket.SOCK_STREAM)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    async with serving(connections_of(listener), listener, **files) as port:
        yield port, ssl.create_default_context(cafile=access / "ca.pem")


async def ended(reader):
    with contextlib.suppress(ConnectionError):
        return await reader.read() == b""
    return True


async def test_connections_beyond_the_limit_are_closed_at_once():
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


async def test_connections_of_one_address_are_limited():
    """The first address has its share, is refused beyond it, and gets it again when its connections ended."""
    with FairListener(socket.AF_INET, socket.SOCK_STREAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.listen()
        kind = connections_of(bound)
        kind.per_address = MOST
        async with serving(kind, bound) as port:
            opened = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
            assert await served(opened) == [True] * MOST
            more = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
            assert await served(more) == [False] * MOST
            other = [await asyncio.open_connection("127.0.0.1", port, local_addr=("127.0.0.2", 0))]
            assert await served(other) == [True]
            for reader, writer in opened:
                writer.write(b"GET / HTTP/1.1\r\nhost: here\r\nconnection: close\r\n\r\n")
                await reader.read()
                writer.close()
            again = [await asyncio.open_connection("127.0.0.1", port)]
            assert await served(again) == [True]
            again[0][1].close()
            other[0][1].close()


async def served(opened):
    """Ask for a page on each connection; return which of them answer."""
    for _, writer in opened:
        writer.write(b"GET / HTTP/1.1\r\nhost: here\r\n\r\n")
    return [await _answers(reader) for reader, _ in opened]


async def _answers(reader):
    with contextlib.suppress(ConnectionError):
        return b"200" in await reader.readline()
    return False


async def test_silent_connections_are_closed():
    async with serving(Few) as port:
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
        for _, writer in silent[::2]:
            writer.write(b"GET / HTTP/1.1\r\nhost: ")
        assert await asyncio.gather(*(ended(reader) for reader, _ in silent)) == [True] * MOST
        async with httpx.AsyncClient(trust_env=False) as http:
            assert (await http.get(f"http://127.0.0.1:{port}/")).text == "here"
        for _, writer in silent:
            writer.close()


async def test_pending_handshakes_are_bounded(tmp_path):
    async with serving_by_tls(PatientListener, tmp_path) as (port, trusting):
        asking = await asyncio.open_connection("127.0.0.1", port, ssl=trusting)
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
        more = [await asyncio.open_connection("127.0.0.1", port) for _ in range(40 * MOST)]
        assert await asyncio.gather(*(ended(reader) for reader, _ in more)) == [True] * len(more)
        asking[1].write(b"GET / HTTP/1.1\r\nhost: here\r\n\r\n")
        assert b"200" in await asking[0].readline(), "who shook hands before is served on"
        silent[0][1].close()
        await silent[0][1].wait_closed()
        again = await _shaking_hands(port, trusting)
        for _, writer in [asking, again, *silent, *more]:
            writer.close()


async def test_pending_handshakes_of_one_address_leave_room_for_others(tmp_path):
    async with serving_by_tls(FairListener, tmp_path) as (port, trusting):
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(8 * MOST)]
        async with asyncio.timeout(10):
            _, writer = await asyncio.open_connection(
                "127.0.0.1", port, ssl=trusting, local_addr=("127.0.0.2", 0)
            )
        for _, ending in [(None, writer), *silent]:
            ending.close()


async def test_pending_handshakes_time_out(tmp_path):
    async with serving_by_tls(HastyListener, tmp_path) as (port, trusting):
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST)]
        assert await asyncio.gather(*(ended(reader) for reader, _ in silent)) == [True] * MOST
        _, writer = await _shaking_hands(port, trusting)
        for _, ending in [(None, writer), *silent]:
            ending.close()


async def _shaking_hands(port, trusting):
    """Open a connection as soon as the server has a free place."""
    async with asyncio.timeout(20):
        while True:
            with contextlib.suppress(OSError):
                return await asyncio.open_connection("127.0.0.1", port, ssl=trusting)
            await asyncio.sleep(0.05)
