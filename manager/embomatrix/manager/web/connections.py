"""How many connections the HTTP port holds, and for how long one may say nothing."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
from typing import TYPE_CHECKING, Any, Final, cast

from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    from uvicorn import Config
    from uvicorn.server import ServerState

CONNECTIONS: Final = 2048
"""At most. A page opens six, a stream of events holds one."""
SILENT_S: Final = 10.0
"""From a connection's beginning to its first whole request."""
FILES: Final = 65_536
"""Open files that the manager asks for: sockets of workers, trainers and viewers, bundles, the store."""


class BoundedConnections(H11Protocol):
    """One connection. It is closed at once where too many are open, and soon where nothing is asked on it."""

    most = CONNECTIONS
    silent_s = SILENT_S
    door: BoundedListener | None = None
    """Through which they come."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # A protocol takes any transport; uvicorn's takes a stream's alone, which is what a server opens.
        super().connection_made(cast("asyncio.Transport", transport))
        if self.door is not None:
            self.door.entered(transport.get_extra_info("peername"))
        if len(self.connections) > self.most:
            self.transport.abort()
        else:
            self._patience = self.loop.call_later(self.silent_s, self._close_silent)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._patience is not None:
            self._patience.cancel()
        super().connection_lost(exc)

    def _close_silent(self) -> None:
        # The first whole request makes it.
        if self.cycle is None:
            self.transport.abort()


def connections_through(door: BoundedListener) -> type[BoundedConnections]:
    """Those of a server that listens at this door."""
    return type("ConnectionsThroughADoor", (BoundedConnections,), {"door": door})


def allow_files() -> None:
    """Raise this process's own limit of open files towards ``FILES``, as far as the system lets it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


WAITING: Final = 256
"""Connections at most that were accepted and have not shaken hands. TLS takes 300 kB for one before it has said a word."""
HANDSHAKE_S: Final = 10.0
"""A handshake may take so long."""
TURNED_AWAY_AT_A_TIME: Final = 256
"""Then other work of the process gets its turn."""


class BoundedListener(socket.socket):
    """For an asyncio server, which calls ``accept`` within its loop. Who comes when it is full is turned away at once."""

    most = WAITING
    patience_s = HANDSHAKE_S

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self._waiting: dict[object, asyncio.TimerHandle] = {}

    def accept(self) -> tuple[socket.socket, Any]:
        for _ in range(TURNED_AWAY_AT_A_TIME):
            plain, peer = super().accept()
            if len(self._waiting) < self.most:
                return self._take_in(plain, peer), peer
            plain.close()
        raise BlockingIOError

    def entered(self, peer: object) -> None:
        """The connection from this address shook hands, or is over: it waits no longer."""
        timer = self._waiting.pop(peer, None)
        if timer is not None:
            timer.cancel()

    def _take_in(self, plain: socket.socket, peer: object) -> socket.socket:
        guest = _Guest(plain, lambda: self.entered(peer))
        self._waiting[peer] = asyncio.get_running_loop().call_later(self.patience_s, guest.send_away)
        return guest


class _Guest(socket.socket):
    """An accepted connection, which tells when it is over."""

    def __init__(self, plain: socket.socket, on_close: Callable[[], None]) -> None:
        super().__init__(plain.family, plain.type, plain.proto, fileno=plain.detach())
        self._on_close = on_close

    def close(self) -> None:
        self._on_close()
        super().close()

    def send_away(self) -> None:
        """End it so that whoever waits for its words hears of it."""
        with contextlib.suppress(OSError):
            self.shutdown(socket.SHUT_RDWR)
