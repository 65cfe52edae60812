"""gRPC channels to a manager: common options, TLS, and the token on every call."""

import re
from collections.abc import Callable
from typing import Any, Final

import grpc

from embomatrix.rpc.logs import hide
from embomatrix.rpc.status import InvalidRequestError

DEFAULT_ADDRESS: Final = "127.0.0.1:50070"
MAX_MESSAGE_BYTES: Final = 32 * 1024 * 1024
CHUNK_BYTES: Final = 1024 * 1024
"""Size of the chunks of a bundle."""
TOKEN_KEY: Final = "authorization"
TOKEN_PATTERN: Final = r"^[!-~]*$"
"""Visible ASCII without spaces, the characters that call metadata can carry."""
_ADDRESS: Final = re.compile(r"(?:\[[0-9A-Fa-f:.%\w]+\]|[^\s:/\[\]]+):(\d{1,5})")

KEEPALIVE_TIME_MS: Final = 30_000
KEEPALIVE_TIMEOUT_MS: Final = 10_000
HANDSHAKE_MS: Final = 10_000
"""Time limit for the first bytes of a connection."""
IDLE_MS: Final = 300_000
"""A connection without a call is closed after this time. Clients connect again with their next call."""
MIN_PING_INTERVAL_MS: Final = 10_000
"""A server disconnects clients that ping more often."""

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
    # Without it, channels of one process share a connection, and a bundle transfer delays heartbeats.
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
    # Silent connections are closed, before the first call and between calls.
    ("grpc.server_handshake_timeout_ms", HANDSHAKE_MS),
    ("grpc.max_connection_idle_ms", IDLE_MS),
    # A second manager on the same port must fail to bind; with SO_REUSEPORT the two would share the calls.
    ("grpc.so_reuseport", 0),
)


def open_channel(address: str, token: str = "", ca: bytes = b"") -> grpc.aio.Channel:
    """Return a channel to HOST:PORT that sends the token with every call and connects on first use.

    ``ca`` is the PEM certificate of the authority that signs the manager's certificate; without it there is no TLS. The token
    is masked in log lines. Raises InvalidRequestError for an invalid address or token.
    """
    if not is_address(address):
        raise InvalidRequestError(
            f"{address!r} is not a manager address: expected HOST:PORT, as in {DEFAULT_ADDRESS}"
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
    """Return True if the text is HOST:PORT, with an IPv6 host in brackets."""
    found = _ADDRESS.fullmatch(text)
    return found is not None and 0 < int(found[1]) <= 65535


def bearer(token: str) -> str:
    """Return the value of the ``authorization`` key for a token."""
    return f"Bearer {token}"


def token_of(header: str | None) -> str:
    """Return the token in the value of an ``authorization`` key, or an empty text."""
    return (header or "").removeprefix("Bearer ")


def chunks_of(data: bytes) -> list[bytes]:
    """Split the data into pieces of at most ``CHUNK_BYTES``. Empty data is one empty piece."""
    return [data[start : start + CHUNK_BYTES] for start in range(0, max(len(data), 1), CHUNK_BYTES)]


class _Token:
    """Adds the token to the metadata of a call of any kind."""

    def __init__(self, token: str) -> None:
        self._value = bearer(token)

    async def _intercept(
        self, continuation: Callable[..., Any], details: grpc.aio.ClientCallDetails, request: Any
    ) -> Any:
        metadata = grpc.aio.Metadata(*(details.metadata or ()), (TOKEN_KEY, self._value))
        signed = grpc.aio.ClientCallDetails(
            details.method, details.timeout, metadata, details.credentials, details.wait_for_ready
        )
        return await continuation(signed, request)

    intercept_unary_unary = intercept_unary_stream = _intercept
    intercept_stream_unary = intercept_stream_stream = _intercept


# grpc.aio assigns an interceptor to the first kind of call whose class it inherits, so each kind needs a class.
_INTERCEPTORS: Final = tuple(
    type(f"_{kind.__name__}Token", (_Token, kind), {})
    for kind in (
        grpc.aio.UnaryUnaryClientInterceptor,
        grpc.aio.UnaryStreamClientInterceptor,
        grpc.aio.StreamUnaryClientInterceptor,
        grpc.aio.StreamStreamClientInterceptor,
    )
)
