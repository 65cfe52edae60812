"""Wait for a condition, or for a server process to accept connections."""

import asyncio
import contextlib
import socket
import time

import pytest


async def until(condition, limit_s):
    """Wait until other tasks or processes make the condition true. Raises TimeoutError."""
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110  # the conditions have no event to wait for
            await asyncio.sleep(0.005)


def until_listening(address, limit_s=60.0):
    """Wait until HOST:PORT accepts a connection."""
    host, _, port = address.partition(":")
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=1):
            return
        time.sleep(0.1)
    pytest.fail(f"no server listens at {address}")
