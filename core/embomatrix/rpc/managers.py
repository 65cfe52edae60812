"""Connections to the managers of one cluster, of which one leads and the others stand by."""

import asyncio
import functools
import time
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Concatenate, Final, ParamSpec, Self, TypeVar

import grpc

from embomatrix.rpc.channel import DEFAULT_ADDRESS, is_address, open_channel
from embomatrix.rpc.status import (
    ClusterError,
    InvalidRequestError,
    StandbyError,
    UnavailableError,
    cluster_errors,
)

PAUSE_S: Final = 0.2
"""Pause between calls to two managers."""
FAILOVER_S: Final = 20.0
"""Default time to wait for another manager to take over, where several addresses are known."""
P = ParamSpec("P")
T = TypeVar("T")
C = TypeVar("C", bound="LeaderClient")


class Managers:
    """Manager addresses of a worker or trainer, and the one in use.

    ``text`` is ``HOST:PORT``, or several with commas between them. Raises InvalidRequestError.
    """

    def __init__(self, text: str) -> None:
        self.addresses = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
        for address in self.addresses:
            if not is_address(address):
                raise InvalidRequestError(
                    f"{address!r} is not a manager address: expected HOST:PORT, as in {DEFAULT_ADDRESS}, or several with "
                    "commas between them"
                )
        self.current = self.addresses[0]

    @property
    def count(self) -> int:
        return len(self.addresses)

    def move(self, error: ClusterError) -> None:
        """Switch to another manager after a failed call: to the leader that a standby named, else to the next address.

        A leader outside the configured addresses is ignored, since calls carry a token.
        """
        if isinstance(error, StandbyError) and error.leader in self.addresses:
            self.current = error.leader
            return
        following = self.addresses.index(self.current) + 1
        self.current = self.addresses[following % self.count]


class LeaderClient:
    """Async context manager over channels to the leading manager of a cluster.

    ``address`` is HOST:PORT, or several with commas between them. ``ca`` (PEM) turns TLS on. Every failure is a ClusterError.
    """

    def __init__(self, address: str, token: str, *, ca: bytes, failover_s: float) -> None:
        self.managers = Managers(address)
        self.failover_s = failover_s
        self._token = token
        self._ca = ca
        self._channels: dict[str, grpc.aio.Channel] = {}

    async def __aenter__(self) -> Self:
        _ = self._channel  # a token that cannot be sent is refused here, not at the first call
        return self

    async def __aexit__(self, *_: object) -> None:
        for channel in self._channels.values():
            await channel.close()

    @property
    def _address(self) -> str:
        return self.managers.current

    @property
    def _channel(self) -> grpc.aio.Channel:
        """Channel to the current manager. Earlier channels stay open, since calls may still use them."""
        if self._address not in self._channels:
            self._channels[self._address] = open_channel(self._address, self._token, self._ca)
        return self._channels[self._address]


def of_the_leader(
    method: Callable[Concatenate[C, P], Awaitable[T]],
) -> Callable[Concatenate[C, P], Coroutine[Any, Any, T]]:
    """Translate the errors of a client's call, and repeat it at the next manager while the current one is unavailable."""

    @functools.wraps(method)
    async def call(self: C, /, *args: P.args, **options: P.kwargs) -> T:
        ends_s = time.monotonic() + self.failover_s
        while True:
            try:
                with cluster_errors(self._address):
                    return await method(self, *args, **options)
            except UnavailableError as error:
                if self.managers.count == 1 or time.monotonic() >= ends_s:
                    raise
                self.managers.move(error)
            await asyncio.sleep(PAUSE_S)

    return call
