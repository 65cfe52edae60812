"""A listening socket that bounds how many connections are on their way in, before anything is done for one of them."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

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
