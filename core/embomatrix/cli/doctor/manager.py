"""Whether a manager can be reached from here: by the network, by TLS, in a version that both speak, with the token in hand."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import socket
import ssl
import time
from dataclasses import dataclass, field
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Final

from embomatrix.cli.doctor.findings import Finding, Level
from embomatrix.proto.v1 import rollout_service_pb2_grpc
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.status import ClusterError, NotAllowedError, PreconditionError, cluster_errors
from embomatrix.rpc.versions import SPOKEN, Capabilities, agree, capabilities_of, software_version

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.rpc.wire.values import FleetStatus

KNOCK_S: Final = 1.0
"""Limit for each of the questions, of which there are four: a doctor is quick."""
CERTIFICATE_DAYS: Final = 30
"""`manager init` renews a certificate with less than this left."""
CLOCK_S: Final = 60.0
OUT_OF_TIME: Final = frozenset({9, 10})
"""X509_V_ERR_CERT_NOT_YET_VALID and X509_V_ERR_CERT_HAS_EXPIRED."""
DAY_S: Final = 86400.0
CALM: Final = frozenset({"good", "idle"})
"""Moods of a cluster that nobody needs to care about."""
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True, slots=True)
class Visit:
    """Whom to visit, and what to show there. ``ca`` is PEM; ``page_port`` is that of the status page."""

    address: str
    token: str = field(default="", repr=False)
    ca: bytes = b""
    page_port: int = 8070
    expected: bool = True
    """Whether somebody named this manager, or it is only where one would be by default."""

    @property
    def host(self) -> str:
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        return int(self.address.rpartition(":")[2])

    @property
    def is_here(self) -> bool:
        """On this machine's loopback interface."""
        return self.host in LOOPBACK


async def manager(visit: Visit) -> list[Finding]:
    """Knock, and go on for as long as there is an answer."""
    reached = await asyncio.to_thread(_reach, visit)
    findings = [reached]
    if reached.level is not Level.FINE:
        return findings
    secured = await asyncio.to_thread(_tls, visit)
    findings.append(secured)
    if secured.level is Level.WRONG:
        return findings
    spoken = await _versions(visit)
    findings.append(spoken)
    if spoken.level is Level.WRONG:
        return findings
    findings += await _token(visit)
    offset_s = await asyncio.to_thread(_clock_offset_s, visit)
    if offset_s is not None:
        findings.append(clock(offset_s))
    return findings


def ports_held(visit: Visit, findings: Sequence[Finding]) -> frozenset[int]:
    """Ports of this machine that the manager was found to serve at."""
    well = {finding.thing for finding in findings if finding.level is not Level.WRONG}
    served = {"versions": visit.port, "clock": visit.page_port}
    return frozenset(port for thing, port in served.items() if visit.is_here and thing in well)


def certificate(days_left: float) -> Finding:
    """How long the manager's certificate still holds."""
    found = f"by TLS, its certificate holds {days_left:.0f} days more"
    if days_left < CERTIFICATE_DAYS:
        return Finding(
            "TLS", Level.NOTE, found, "run `embomatrix manager init` there again: it makes a new one"
        )
    return Finding("TLS", Level.FINE, found)


def mistrust(code: int, message: str) -> Finding:
    """Why the manager's certificate was refused, by OpenSSL's code."""
    remedy = "pass the ca.pem of this manager with --ca; a name that it lacks is added by `manager init --san NAME`"
    if code in OUT_OF_TIME:
        remedy = "is this machine's clock right? If so, run `embomatrix manager init` there again: it makes a new certificate"
    return Finding("TLS", Level.WRONG, message, remedy)


def versions(found: Capabilities) -> Finding:
    """Whether both sides speak one protocol; other releases than our own are told."""
    try:
        spoken = agree(
            SPOKEN, found.protocol, us="this trainer", them="that manager", their_release=found.release
        )
    except PreconditionError as error:
        return Finding("versions", Level.WRONG, f"protocol {found.protocol} there, {SPOKEN} here", str(error))
    told = f"protocol {spoken}, release {found.release or 'unknown'}"
    if found.release and software_version() and found.release != software_version():
        return Finding(
            "versions", Level.NOTE, f"{told} there, {software_version()} here", "they work together"
        )
    return Finding("versions", Level.FINE, told)


def clock(offset_s: float) -> Finding:
    """This machine's clock less the manager's."""
    found = f"{abs(offset_s):.0f} s {'ahead of' if offset_s > 0 else 'behind'} the manager's"
    if abs(offset_s) < CLOCK_S:
        return Finding("clock", Level.FINE, found)
    remedy = (
        "let NTP set it: leases don't mind, but certificates may seem expired and logs don't fit together"
    )
    return Finding("clock", Level.NOTE, found, remedy)


def _reach(visit: Visit) -> Finding:
    try:
        socket.create_connection((visit.host, visit.port), KNOCK_S).close()
    except OSError as error:
        if not visit.expected:
            return Finding(
                "manager", Level.NOTE, f"none at {visit.address}", "name yours with --manager HOST:PORT"
            )
        remedy = "is it running, is the address right, does a firewall let its port through?"
        return Finding("manager", Level.WRONG, f"{visit.address}: {error.strerror or error}", remedy)
    return Finding("manager", Level.FINE, f"{visit.address} answers")


def _tls(visit: Visit) -> Finding:
    context = ssl.create_default_context(cadata=visit.ca.decode("ascii")) if visit.ca else _trusting()
    context.set_alpn_protocols(["h2"])
    try:
        with (
            socket.create_connection((visit.host, visit.port), KNOCK_S) as plain,
            context.wrap_socket(plain, server_hostname=visit.host) as tls,
        ):
            shown = tls.getpeercert()
    except ssl.SSLCertVerificationError as error:
        return mistrust(error.verify_code, error.verify_message)
    except OSError:
        if visit.ca:
            return Finding("TLS", Level.WRONG, "it does not speak TLS", "leave --ca and EMBOMATRIX_CA out")
        return Finding("TLS", Level.FINE, "none: it serves in the clear, as on loopback")
    if not visit.ca:
        remedy = "pass its ca.pem with --ca, or EMBOMATRIX_CA"
        return Finding("TLS", Level.WRONG, "it serves by TLS, and no authority to trust was named", remedy)
    ends_s = ssl.cert_time_to_seconds(str((shown or {}).get("notAfter")))
    return certificate((ends_s - time.time()) / DAY_S)


def _trusting() -> ssl.SSLContext:
    """Only asks whether there is TLS at all."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


async def _versions(visit: Visit) -> Finding:
    try:
        async with open_channel(visit.address, ca=visit.ca) as channel:
            stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
            with cluster_errors(visit.address):
                return versions(await capabilities_of(stub, timeout_s=KNOCK_S))
    except ClusterError as error:
        return Finding("versions", Level.WRONG, str(error), "is this the port of a manager's gRPC services?")


async def _token(visit: Visit) -> list[Finding]:
    """What becomes of who shows it, and what the manager says of the cluster then."""
    try:
        async with AdminClient(
            visit.address, visit.token, ca=visit.ca, call_s=KNOCK_S, failover_s=0
        ) as client:
            fleet = await client.fleet()
    except NotAllowedError as error:
        return [Finding("token", Level.FINE, f"is known; {error}")]
    except ClusterError as error:
        remedy = "tokens are made by `embomatrix manager token issue`"
        return [Finding("token", Level.WRONG, str(error), remedy)]
    found = Finding("token", Level.FINE, "is known" if visit.token else "none is asked for")
    return [found, *cluster(fleet)]


def cluster(fleet: FleetStatus) -> list[Finding]:
    """How the cluster does, if its manager says so. It is no fault of this machine: never worse than a note."""
    if not fleet.health:
        return []
    ready = sum(worker.state == "ready" for worker in fleet.workers)
    found = f"{fleet.health} Workers that are ready: {ready}"
    if fleet.mood in CALM:
        return [Finding("cluster", Level.FINE, found)]
    return [Finding("cluster", Level.NOTE, found, "`embomatrix status` and the dashboard say more")]


def _clock_offset_s(visit: Visit) -> float | None:
    """By the date in the status page's answer; None where no page answers. Right to a second."""
    if visit.ca:
        context = ssl.create_default_context(cadata=visit.ca.decode("ascii"))
        page: http.client.HTTPConnection = http.client.HTTPSConnection(
            visit.host, visit.page_port, timeout=KNOCK_S, context=context
        )
    else:
        page = http.client.HTTPConnection(visit.host, visit.page_port, timeout=KNOCK_S)
    with contextlib.closing(page), contextlib.suppress(OSError, http.client.HTTPException, ValueError):
        page.request("GET", "/healthz")
        return time.time() - parsedate_to_datetime(page.getresponse().headers["date"] or "").timestamp()
    return None
