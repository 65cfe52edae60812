"""What a manager is: versions of its protocol and its software, limits, and the authority that signed its certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.status import cluster_errors
from embomatrix.rpc.versions import SPOKEN, VersionRange, agree

if TYPE_CHECKING:
    from embomatrix.proto.v1.rollout_service_pb2_grpc import RolloutServiceAsyncStub


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Versions, limits and certificate authority of a manager."""

    protocol: VersionRange
    release: str = ""
    batch_rollouts: int = 0
    bundle_bytes: int = 0
    ca_certificate: str = ""
    """PEM; empty without TLS."""


async def capabilities_of(stub: RolloutServiceAsyncStub, address: str, *, timeout_s: float) -> Capabilities:
    """Ask the manager behind the stub. Raises ClusterError."""
    with cluster_errors(address):
        answer = await stub.GetCapabilities(pb.GetCapabilitiesRequest(), timeout=timeout_s)
    return Capabilities(
        VersionRange(answer.protocol_low, answer.protocol_high),
        answer.version,
        answer.batch_rollouts,
        answer.bundle_bytes,
        answer.ca_certificate,
    )


async def version_with(stub: RolloutServiceAsyncStub, address: str, *, timeout_s: float) -> int:
    """The protocol version that a trainer and the manager behind the stub both speak. PreconditionError for none."""
    found = await capabilities_of(stub, address, timeout_s=timeout_s)
    return agree(
        SPOKEN,
        found.protocol,
        us="this trainer",
        them=f"the manager at {address}",
        their_release=found.release,
    )
