"""Listening sockets of the manager, with remedies for addresses that cannot be bound."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final

import grpc

from embomatrix.manager.web.connections import BoundedListener

if TYPE_CHECKING:
    from embomatrix.manager.access.protection import Tls


class PortInUseError(Exception):
    """Address that cannot be bound. The message names a remedy."""


REMEDIES: Final[Mapping[int, str]] = {
    errno.EADDRINUSE: "stop the program that uses it, or pass another --{option}port (0 takes a free one)",
    errno.EADDRNOTAVAIL: "pass an address of this machine as --{option}host",
    errno.EACCES: "pass a --{option}port above 1023",
}


@contextlib.contextmanager
def bound_socket(host: str, port: int, *, option: str = "") -> Iterator[BoundedListener]:
    """Yield a socket bound to the address. ``option`` is the prefix of its command-line options.

    Raises PortInUseError.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with BoundedListener(family, socket.SOCK_STREAM) as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((host, port))
        except OSError as error:
            remedy = REMEDIES.get(error.errno or 0, "check --{option}host and --{option}port")
            raise PortInUseError(
                f"{host}:{port} can't be bound ({error.strerror}): {remedy.format(option=option)}"
            ) from error
        yield bound


def bind_server(server: grpc.aio.Server, host: str, port: int, tls: Tls | None) -> int:
    """Bind a gRPC server, with TLS if there is a certificate. Return its port. Raises PortInUseError."""
    address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    try:
        if tls is None:
            return int(server.add_insecure_port(address))
        return int(server.add_secure_port(address, grpc.ssl_server_credentials([(tls.key, tls.chain)])))
    except RuntimeError as error:
        raise PortInUseError(f"{address} can't be bound ({error}): pass another --port") from error
