"""Findings about the connection to a manager: network, TLS, versions, token and clock."""

import asyncio
import contextlib
import http.client
import socket
import ssl
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from email.utils import parsedate_to_datetime
from typing import Final

from embomatrix.cli.doctor.machine import Finding, Level
from embomatrix.proto.v1 import rollout_service_pb2_grpc
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.status import ClusterError, NotAllowedError, PreconditionError, cluster_errors
from embomatrix.rpc.trust import tls_context
from embomatrix.rpc.versions import SPOKEN, Capabilities, agree, capabilities_of, software_version
from embomatrix.rpc.wire.values import FleetStatus

TIMEOUT_S: Final = 3.0
"""Timeout of each of the four requests."""
CERTIFICATE_DAYS: Final = 30
"""`manager init` renews certificates with less than this left."""
CLOCK_S: Final = 60.0
OUT_OF_TIME: Final = frozenset({9, 10})
"""X509_V_ERR_CERT_NOT_YET_VALID and X509_V_ERR_CERT_HAS_EXPIRED."""
DAY_S: Final = 86400.0
CALM: Final = frozenset({"good", "idle"})
"""Moods of a cluster that call for no action."""
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True, slots=True)
class Visit:
    """A manager to check, with credentials. ``ca`` is PEM."""

    address: str
    token: str = field(default="", repr=False)
    ca: bytes = b""
    page_port: int = 8070
    expected: bool = True
    """True if the user named this manager; False for the default address."""

    @property
    def host(self) -> str:
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        return int(self.address.rpartition(":")[2])

    @property
    def is_here(self) -> bool:
        """True if the address is on the loopback interface."""
        return self.host in LOOPBACK


async def manager(visit: Visit) -> list[Finding]:
    """Run the checks in order until one fails."""
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
    """Return the ports of this machine that the manager serves."""
    well = {finding.thing for finding in findings if finding.level is not Level.WRONG}
    served = {"versions": visit.port, "clock": visit.page_port}
    return frozenset(port for thing, port in served.items() if visit.is_here and thing in well)


def certificate(days_left: float) -> Finding:
    """Judge the remaining validity of the manager's certificate."""
    found = f"TLS; its certificate is valid for {days_left:.0f} more days"
    if days_left < CERTIFICATE_DAYS:
        return Finding(
            "TLS", Level.NOTE, found, "run `embomatrix manager init` there again: it makes a new one"
        )
    return Finding("TLS", Level.FINE, found)


def mistrust(code: int, message: str) -> Finding:
    """Explain a refused certificate, by OpenSSL's error code."""
    remedy = "pass the ca.pem of this manager with --ca; a name that it lacks is added by `manager init --san NAME`"
    if code in OUT_OF_TIME:
        remedy = "is this machine's clock right? If so, run `embomatrix manager init` there again: it makes a new certificate"
    return Finding("TLS", Level.WRONG, message, remedy)


def versions(found: Capabilities) -> Finding:
    """Judge the protocol versions of both sides; note a different release."""
    try:
        spoken = agree(
            SPOKEN, found.protocol, us="this trainer", them="that manager", their_release=found.release
        )
    except PreconditionError as error:
        return Finding("versions", Level.WRONG, f"protocol {found.protocol} there, {SPOKEN} here", str(error))
    theirs = f"protocol {spoken}, release {found.release or 'unknown'}"
    if found.release and software_version() and found.release != software_version():
        return Finding(
            "versions", Level.NOTE, f"{theirs} there, {software_version()} here", "they work together"
        )
    return Finding("versions", Level.FINE, theirs)


def clock(offset_s: float) -> Finding:
    """Judge the offset of this machine's clock from the manager's, in seconds."""
    found = f"{abs(offset_s):.0f} s {'ahead of' if offset_s > 0 else 'behind'} the manager's"
    if abs(offset_s) < CLOCK_S:
        return Finding("clock", Level.FINE, found)
    remedy = "set it by NTP: leases are not affected, but certificates may seem expired and log times differ"
    return Finding("clock", Level.NOTE, found, remedy)


def _reach(visit: Visit) -> Finding:
    try:
        socket.create_connection((visit.host, visit.port), TIMEOUT_S).close()
    except OSError as error:
        if not visit.expected:
            return Finding(
                "manager", Level.NOTE, f"none at {visit.address}", "name yours with --manager HOST:PORT"
            )
        remedy = "is it running, is the address right, does a firewall let its port through?"
        return Finding("manager", Level.WRONG, f"{visit.address}: {error.strerror or error}", remedy)
    return Finding("manager", Level.FINE, f"{visit.address} answers")


def _tls(visit: Visit) -> Finding:
    try:
        with (
            socket.create_connection((visit.host, visit.port), TIMEOUT_S) as plain,
            tls_context(visit.ca).wrap_socket(plain, server_hostname=visit.host) as tls,
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


async def _versions(visit: Visit) -> Finding:
    try:
        async with open_channel(visit.address, ca=visit.ca) as channel:
            stub = rollout_service_pb2_grpc.RolloutServiceStub(channel)
            with cluster_errors(visit.address):
                return versions(await capabilities_of(stub, timeout_s=TIMEOUT_S))
    except ClusterError as error:
        return Finding("versions", Level.WRONG, str(error), "is this the port of a manager's gRPC services?")


async def _token(visit: Visit) -> list[Finding]:
    """Judge the token, and the state of the cluster if the token may read it."""
    try:
        async with AdminClient(
            visit.address, visit.token, ca=visit.ca, call_s=TIMEOUT_S, failover_s=0
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
    """Report the state of the cluster. It is no fault of this machine: at most a note."""
    ready = sum(worker.state == "ready" for worker in fleet.workers)
    found = f"{fleet.health} Workers that are ready: {ready}"
    if fleet.mood in CALM:
        return [Finding("cluster", Level.FINE, found)]
    return [Finding("cluster", Level.NOTE, found, "`embomatrix status` and the dashboard say more")]


def _clock_offset_s(visit: Visit) -> float | None:
    """Return the clock offset by the status page's Date header, to one second; None without an answer."""
    if visit.ca:
        context = ssl.create_default_context(cadata=visit.ca.decode("ascii"))
        page: http.client.HTTPConnection = http.client.HTTPSConnection(
            visit.host, visit.page_port, timeout=TIMEOUT_S, context=context
        )
    else:
        page = http.client.HTTPConnection(visit.host, visit.page_port, timeout=TIMEOUT_S)
    with contextlib.closing(page), contextlib.suppress(OSError, http.client.HTTPException, ValueError):
        page.request("GET", "/healthz")
        return time.time() - parsedate_to_datetime(page.getresponse().headers["date"] or "").timestamp()
    return None
