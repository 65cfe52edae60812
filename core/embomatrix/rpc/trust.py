"""Certificate authority that a client trusts, and invitations that carry its fingerprint to a new worker."""

import asyncio
import contextlib
import hashlib
import re
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from embomatrix.proto.v1 import rollout_service_pb2_grpc
from embomatrix.rpc.channel import is_address, open_channel
from embomatrix.rpc.status import (
    InvalidRequestError,
    ManagerUnreachableError,
    NotAllowedError,
    UnavailableError,
    cluster_errors,
)
from embomatrix.rpc.versions import capabilities_of

FIRST_CONTACT_S: Final = 10.0
"""Time limit for the handshake and the first answer of a manager with an unknown certificate."""
_TOKEN: Final = re.compile(r"([0-9A-Za-z_-]+\.[0-9A-Za-z_-]+)(?:\.([0-9a-f]{64}))?")
_CERTIFICATE_CHARS: Final = 16_384
"""Characters in which a certificate is looked for. One has about 1,000."""
_CERTIFICATE: Final = re.compile(
    r"-----BEGIN CERTIFICATE-----\s.+?\s-----END CERTIFICATE-----", re.DOTALL | re.ASCII
)


def read_token(text: str) -> str:
    """Return the token, or the content of FILE for ``@FILE``. Raises InvalidRequestError."""
    if not text.startswith("@"):
        return text
    try:
        return Path(text[1:]).expanduser().read_text(encoding="ascii").strip()
    except (OSError, ValueError, RuntimeError) as error:
        if isinstance(error, OSError):
            problem = error.strerror
        else:
            # Paths with a null character, and with the home of an unknown user, raise the others.
            problem = "it contains no token" if isinstance(error, UnicodeDecodeError) else str(error)
        raise InvalidRequestError(
            f"--token {text}: the file can't be read ({problem}): name the file that contains the token"
        ) from error


def read_ca(path: Path | None) -> bytes:
    """Return the authority's certificate (PEM) in a file; empty for no file. Raises InvalidRequestError."""
    if path is None:
        return b""
    try:
        text = path.expanduser().read_text(encoding="ascii")
        fingerprint_of(text)
    except OSError as error:
        raise InvalidRequestError(
            f"--ca {path}: the file can't be read ({error.strerror}): name the manager's ca.pem"
        ) from error
    except ValueError as error:
        raise InvalidRequestError(
            f"--ca {path}: it contains no certificate: pass the ca.pem that `embomatrix manager init` wrote"
        ) from error
    return text.encode("ascii")


def fingerprint_of(pem: str) -> str:
    """Return the SHA-256 of the first certificate in the text, as hexadecimal digits. Raises ValueError without one."""
    found = _CERTIFICATE.search(pem[:_CERTIFICATE_CHARS])
    if found is None:
        raise ValueError("there is no certificate in it")
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(found[0])).hexdigest()


@dataclass(frozen=True, slots=True)
class Invitation:
    """Invitation of a worker, ``TOKEN@HOST:PORT``. With TLS, TOKEN ends in the authority's fingerprint."""

    address: str
    """HOST:PORT, or several with commas between them."""
    token: str = field(repr=False)
    fingerprint: str = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse an invitation. Raises InvalidRequestError without showing the token."""
        token, _, address = text.partition("@")
        found = _TOKEN.fullmatch(token)
        if found is None or not all(is_address(part) for part in address.split(",")):
            raise InvalidRequestError(
                "--join: expected TOKEN@HOST:PORT as `embomatrix manager token issue --role join` printed it"
            )
        return cls(address, found[1], found[2] or "")

    def __str__(self) -> str:
        return f"{'.'.join(filter(None, (self.token, self.fingerprint)))}@{self.address}"

    @property
    def token_id(self) -> str:
        """Public id of the token."""
        return self.token.partition(".")[0]


async def fetch_ca(invitation: Invitation) -> bytes:
    """Return the authority's certificate (PEM), fetched from the manager; empty for an invitation without a
    fingerprint.

    The first connection accepts any certificate and carries no secret. Its answer must match the invitation's
    fingerprint. Raises NotAllowedError for another fingerprint.
    """
    if not invitation.fingerprint:
        return b""
    *first, last = invitation.address.split(",")
    for address in first:
        # A manager that stands by, or is unreachable, cannot answer.
        with contextlib.suppress(UnavailableError):
            return await _fetch_from(address, invitation.fingerprint)
    return await _fetch_from(last, invitation.fingerprint)


async def _fetch_from(address: str, fingerprint: str) -> bytes:
    met = await asyncio.to_thread(_certificate_at, address)
    async with open_channel(address, ca=met) as channel:
        stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
        with cluster_errors(address):
            found = await capabilities_of(stub, timeout_s=FIRST_CONTACT_S)
    with contextlib.suppress(ValueError):
        if fingerprint_of(found.ca_certificate) == fingerprint:
            return found.ca_certificate.encode("ascii")
    raise NotAllowedError(
        f"the server at {address} is not the manager of this invitation: its authority has another "
        "fingerprint. Ask the operator for a new invitation, and why another machine answers at this address"
    )


def tls_context(ca: bytes = b"") -> ssl.SSLContext:
    """Return a context for gRPC that trusts the authority ``ca`` (PEM); without it, one that accepts any certificate."""
    context = ssl.create_default_context(cadata=ca.decode("ascii") or None)
    if not ca:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols(["h2"])
    return context


def _certificate_at(address: str) -> bytes:
    """Return the certificate (PEM) that HOST:PORT shows, without verification."""
    host, _, port = address.rpartition(":")
    try:
        with (
            socket.create_connection((host.strip("[]"), int(port)), FIRST_CONTACT_S) as plain,
            tls_context().wrap_socket(plain) as tls,
        ):
            shown = tls.getpeercert(binary_form=True)
    except ssl.SSLError as error:
        raise ManagerUnreachableError(
            f"the server at {address} does not speak TLS, but the invitation requires it: check the port"
        ) from error
    except OSError as error:
        raise ManagerUnreachableError(
            f"no manager answers at {address} ({error.strerror or error}): check the address and that the port is open"
        ) from error
    return ssl.DER_cert_to_PEM_cert(shown or b"").encode("ascii")
