"""Proxy between a worker and the manager that drops either direction without closing connections.

Data for a cut direction is held back until the line is restored, like TCP under packet loss.
"""

import asyncio
import contextlib

TO_MANAGER = "to the manager"
TO_WORKER = "to the worker"


class Proxy:
    """Async context manager; the worker connects to ``address``."""

    def __init__(self, manager_port):
        self._manager_port = manager_port
        self._open = {TO_MANAGER: asyncio.Event(), TO_WORKER: asyncio.Event()}
        self._connections = set()
        self.heal()

    async def __aenter__(self):
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.address = f"127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *_):
        self._server.close()
        for connection in self._connections:
            connection.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def cut(self, *directions):
        for direction in directions:
            self._open[direction].clear()

    def heal(self):
        for gate in self._open.values():
            gate.set()

    async def _connected(self, reader, writer):
        self._connections.add(asyncio.current_task())
        with contextlib.suppress(OSError, asyncio.CancelledError):
            manager_reader, manager_writer = await asyncio.open_connection("127.0.0.1", self._manager_port)
            pumps = [
                asyncio.create_task(self._pump(reader, manager_writer, self._open[TO_MANAGER])),
                asyncio.create_task(self._pump(manager_reader, writer, self._open[TO_WORKER])),
            ]
            try:
                await asyncio.wait(pumps)
            finally:
                for pump in pumps:
                    pump.cancel()
        self._connections.discard(asyncio.current_task())

    async def _pump(self, reader, writer, gate):
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                await gate.wait()
                writer.write(data)
                await writer.drain()
        await gate.wait()
        with contextlib.suppress(OSError):
            writer.close()
