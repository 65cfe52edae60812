"""What every client of a cluster has: one manager, or several of which one leads, and a connection to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from embomatrix.rpc.channel import DEFAULT_ADDRESS, open_channel
from embomatrix.rpc.managers import PATIENCE_S, Channels, Managers

if TYPE_CHECKING:
    import grpc


class LeaderClient:
    """Async context manager over channels to the manager at HOST:PORT, or to several (``A:PORT,B:PORT``) of which one leads.

    By TLS if ``ca`` (PEM) names whom to trust. Every failure is a ``ClusterError``.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        token: str = "",
        *,
        ca: bytes = b"",
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._managers = Managers(address)
        self._token = token
        self._ca = ca
        self._patience_s = patience_s

    async def __aenter__(self) -> Self:
        self._channels = Channels(
            self._managers, lambda address: open_channel(address, self._token, self._ca)
        )
        self._channels.present()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._channels.close()

    @property
    def managers(self) -> Managers:
        """Whom this client turns to."""
        return self._managers

    @property
    def patience_s(self) -> float:
        """How long a call is tried anew with the other managers."""
        return self._patience_s

    @property
    def _address(self) -> str:
        return self._managers.current

    @property
    def _channel(self) -> grpc.aio.Channel:
        return self._channels.present()
