"""Wait for a server process to accept connections."""

import contextlib
import socket
import time

import pytest


def until_listening(address, limit_s=60.0):
    """Wait until HOST:PORT accepts a connection."""
    host, _, port = address.partition(":")
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=1):
            return
        time.sleep(0.1)
    pytest.fail(f"no server listens at {address}")
