"""Channels to the manager: one set of options, TLS where there is an authority to trust, and the token on every call."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import grpc

from embomatrix.rpc.logs import hide
from embomatrix.rpc.status import InvalidRequestError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

DEFAULT_ADDRESS: Final = "127.0.0.1:50070"
MAX_MESSAGE_BYTES: Final = 32 * 1024 * 1024
CHUNK_BYTES: Final = 1024 * 1024
"""Bundles travel in chunks of this size."""
TOKEN_KEY: Final = "authorization"
TOKEN_PATTERN: Final = r"^[!-~]*$"
"""Visible ASCII without spaces: what a call's metadata can carry."""
_ADDRESS: Final = re.compile(r"(?:\[[0-9A-Fa-f:.%\w]+\]|[^\s:/\[\]]+):(\d{1,5})")

KEEPALIVE_TIME_MS: Final = 30_000
KEEPALIVE_TIMEOUT_MS: Final = 10_000
MIN_PING_INTERVAL_MS: Final = 10_000
"""A server permits pings this often; a client that pings faster is thrown out."""

CHANNEL_OPTIONS: Final[tuple[tuple[str, int], ...]] = (
    ("grpc.keepalive_time_ms", KEEPALIVE_TIME_MS),
    ("grpc.keepalive_timeout_ms", KEEPALIVE_TIMEOUT_MS),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    ("grpc.initial_reconnect_backoff_ms", 200),
    ("grpc.min_reconnect_backoff_ms", 2_000),
    ("grpc.max_reconnect_backoff_ms", 5_000),
    # Channels of one process would share a connection: a bundle transfer could then delay a heartbeat.
    ("grpc.use_local_subchannel_pool", 1),
)

SERVER_OPTIONS: Final[tuple[tuple[str, int], ...]] = (
    ("grpc.keepalive_time_ms", KEEPALIVE_TIME_MS),
    ("grpc.keepalive_timeout_ms", KEEPALIVE_TIMEOUT_MS),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.min_ping_interval_without_data_ms", MIN_PING_INTERVAL_MS),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", MIN_PING_INTERVAL_MS),
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    # Two managers on one port would share the calls between them: the second must fail to bind.
    ("grpc.so_reuseport", 0),
)


def open_channel(address: str, token: str = "", ca: bytes = b"") -> grpc.aio.Channel:
    """A channel to HOST:PORT that sends the token with every call, and no log line shows; it connects when it is first used.

    ``ca`` is the certificate (PEM) of the authority that the manager's must be signed by; without it there is no TLS.
    Raises InvalidRequestError for an address or a token that can't be one.
    """
    if not is_address(address):
        raise InvalidRequestError(
            f"{address!r} is no address of a manager: expected HOST:PORT, as in {DEFAULT_ADDRESS}"
        )
    if not re.fullmatch(TOKEN_PATTERN, token):
        raise InvalidRequestError("the token can't be sent: expected visible ASCII characters without spaces")
    hide(token)
    interceptors = [interceptor(token) for interceptor in _INTERCEPTORS] if token else None
    if not ca:
        return grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS, interceptors=interceptors)
    trusted = grpc.ssl_channel_credentials(ca)
    return grpc.aio.secure_channel(address, trusted, options=CHANNEL_OPTIONS, interceptors=interceptors)


def is_address(text: str) -> bool:
    """Whether the text is HOST:PORT; an IPv6 host stands in brackets."""
    found = _ADDRESS.fullmatch(text)
    return found is not None and 0 < int(found[1]) <= 65535


def bearer(token: str) -> str:
    """The value of the ``authorization`` key for a token."""
    return f"Bearer {token}"


def token_of(header: str | None) -> str:
    """The token in the value of an ``authorization`` key; empty when there is none."""
    return (header or "").removeprefix("Bearer ")


def chunks_of(data: bytes) -> list[bytes]:
    """The data in pieces of at most ``CHUNK_BYTES``; empty data is one empty piece."""
    return [data[start : start + CHUNK_BYTES] for start in range(0, max(len(data), 1), CHUNK_BYTES)]


class _Token:
    """Adds the token to a call's metadata."""

    def __init__(self, token: str) -> None:
        self._value = bearer(token)

    def sign(self, details: grpc.aio.ClientCallDetails) -> grpc.aio.ClientCallDetails:
        metadata = grpc.aio.Metadata(*(details.metadata or ()), (TOKEN_KEY, self._value))
        return grpc.aio.ClientCallDetails(
            details.method, details.timeout, metadata, details.credentials, details.wait_for_ready
        )


# grpc.aio tells the four kinds of calls apart by the interceptor's class, and takes the first that fits.
class _UnaryUnaryToken(_Token, grpc.aio.UnaryUnaryClientInterceptor):  # type: ignore[misc]  # grpc is untyped
    async def intercept_unary_unary(
        self, continuation: Callable[..., Any], client_call_details: grpc.aio.ClientCallDetails, request: Any
    ) -> Any:
        return await continuation(self.sign(client_call_details), request)


class _UnaryStreamToken(_Token, grpc.aio.UnaryStreamClientInterceptor):  # type: ignore[misc]
    async def intercept_unary_stream(
        self, continuation: Callable[..., Any], client_call_details: grpc.aio.ClientCallDetails, request: Any
    ) -> Any:
        return await continuation(self.sign(client_call_details), request)


class _StreamUnaryToken(_Token, grpc.aio.StreamUnaryClientInterceptor):  # type: ignore[misc]
    async def intercept_stream_unary(
        self,
        continuation: Callable[..., Any],
        client_call_details: grpc.aio.ClientCallDetails,
        request_iterator: AsyncIterator[Any],
    ) -> Any:
        return await continuation(self.sign(client_call_details), request_iterator)


class _StreamStreamToken(_Token, grpc.aio.StreamStreamClientInterceptor):  # type: ignore[misc]
    async def intercept_stream_stream(
        self,
        continuation: Callable[..., Any],
        client_call_details: grpc.aio.ClientCallDetails,
        request_iterator: AsyncIterator[Any],
    ) -> Any:
        return await continuation(self.sign(client_call_details), request_iterator)


_INTERCEPTORS: Final = (_UnaryUnaryToken, _UnaryStreamToken, _StreamUnaryToken, _StreamStreamToken)
