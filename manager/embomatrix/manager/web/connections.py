"""Limits of the HTTP port: connections, TLS handshakes, and silent clients."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, cast

from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

CONNECTIONS: Final = 2048
"""Connections at most. A page opens six, an event stream holds one."""
PER_ADDRESS: Final = 512
"""Connections of one address at most, so that one machine can't shut out the others."""
SILENT_S: Final = 10.0
"""Seconds from the start of a connection to its first whole request."""
FILES: Final = 65_536
"""Requested limit of open files: sockets of workers, trainers and viewers, bundles, and the store."""


Peer = tuple[Any, ...]
"""Address of a client: its host and its port, and two more numbers in IPv6."""


class BoundedConnections(H11Protocol):
    """HTTP connection that is closed at once above ``CONNECTIONS``, and after ``SILENT_S`` without a request."""

    limit = CONNECTIONS
    per_address = PER_ADDRESS
    silent_s = SILENT_S
    listener: BoundedListener | None = None
    """Listener that accepted the connections."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._timer: asyncio.TimerHandle | None = None
        self._address: str | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # uvicorn narrows the parameter's type; a server passes a stream transport only.
        super().connection_made(cast("asyncio.Transport", transport))
        if self.listener is not None:
            self.listener.handshake_done(transport.get_extra_info("peername"))
        self._address = self.client[0] if self.client else ""
        if self.listener is not None:
            self.listener.by_address[self._address] += 1
        crowded = self.listener is not None and self.listener.by_address[self._address] > self.per_address
        if len(self.connections) > self.limit or crowded:
            self.transport.abort()
        else:
            self._timer = self.loop.call_later(self.silent_s, self._close_silent)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self.listener is not None and self._address is not None:
            _count_down(self.listener.by_address, self._address)
            self._address = None
        super().connection_lost(exc)

    def _close_silent(self) -> None:
        # The first whole request creates the cycle.
        if self.cycle is None:
            self.transport.abort()


def _count_down(counts: Counter[str], address: str) -> None:
    counts[address] -= 1
    if not counts[address]:
        del counts[address]


def connections_of(listener: BoundedListener) -> type[BoundedConnections]:
    """Return the connection class of a server that uses this listener."""
    return type("ListenerConnections", (BoundedConnections,), {"listener": listener})


def allow_files() -> None:
    """Raise the process's limit of open files towards ``FILES``, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


WAITING: Final = 256
"""Accepted connections without a finished handshake at most. TLS takes 300 kB for each."""
WAITING_PER_ADDRESS: Final = 64
"""Largest number of them from one address."""
HANDSHAKE_S: Final = 10.0
"""Time limit of a handshake, in seconds."""
REJECTED_AT_ONCE: Final = 256
"""Rejected connections before other work of the process gets a turn."""


class BoundedListener(socket.socket):
    """Listening socket for an asyncio server. When too many handshakes are pending, at all or of one address, new
    connections are closed at once.
    """

    limit = WAITING
    per_address = WAITING_PER_ADDRESS
    handshake_s = HANDSHAKE_S

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self._waiting: dict[Peer, asyncio.TimerHandle] = {}
        self._waiting_by_address: Counter[str] = Counter()
        self.by_address: Counter[str] = Counter()
        """Open HTTP connections by the client's address."""

    def accept(self) -> tuple[socket.socket, Any]:
        for _ in range(REJECTED_AT_ONCE):
            plain, peer = super().accept()
            if len(self._waiting) < self.limit and self._waiting_by_address[peer[0]] < self.per_address:
                return self._take_in(plain, peer), peer
            plain.close()
        raise BlockingIOError

    def handshake_done(self, peer: Peer) -> None:
        """Note that the connection from this address finished its handshake, or is closed."""
        timer = self._waiting.pop(peer, None)
        if timer is not None:
            timer.cancel()
            _count_down(self._waiting_by_address, peer[0])

    def _take_in(self, plain: socket.socket, peer: Peer) -> socket.socket:
        self._waiting_by_address[peer[0]] += 1
        accepted = _AcceptedSocket(plain, lambda: self.handshake_done(peer))
        self._waiting[peer] = asyncio.get_running_loop().call_later(self.handshake_s, accepted.shut_down)
        return accepted


class _AcceptedSocket(socket.socket):
    """Accepted connection that reports its end."""

    def __init__(self, plain: socket.socket, on_close: Callable[[], None]) -> None:
        super().__init__(plain.family, plain.type, plain.proto, fileno=plain.detach())
        self._on_close = on_close

    def close(self) -> None:
        self._on_close()
        super().close()

    def shut_down(self) -> None:
        """Shut the connection down, which wakes its readers."""
        with contextlib.suppress(OSError):
            self.shutdown(socket.SHUT_RDWR)
