"""The operator's side of tokens: hand out, look over, take back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.fleet_client import FleetClient
from embomatrix.rpc.managers import of_the_leader
from embomatrix.rpc.roles import AccessRole, TokenInfo
from embomatrix.rpc.status import cluster_errors
from embomatrix.rpc.wire.rollout import ConvertError, each, finite, required

if TYPE_CHECKING:
    from collections.abc import Mapping

_ROLES: Final[Mapping[AccessRole, pb.Role.ValueType]] = {
    role: pb.Role.Value(f"ROLE_{role.name}") for role in AccessRole
}
_ROLE_VALUES: Final = {number: role for role, number in _ROLES.items()}


def role_from_proto(number: pb.Role.ValueType) -> AccessRole:
    role = _ROLE_VALUES.get(number)
    if role is None:
        raise ConvertError("role", f"{number} is none of {', '.join(AccessRole)}")
    return role


def token_info_to_proto(info: TokenInfo) -> pb.TokenInfo:
    return pb.TokenInfo(
        token_id=info.token_id,
        role=_ROLES[info.role],
        label=info.label,
        left_s=info.left_s,
        worker_id=info.worker_id,
    )


def token_info_from_proto(message: pb.TokenInfo) -> TokenInfo:
    return TokenInfo(
        required("token_id", message.token_id),
        role_from_proto(message.role),
        message.label,
        finite("left_s", message.left_s),
        message.worker_id,
    )


class TokenClient(FleetClient):
    """Async context manager over channels to a cluster. Every failure is a ``ClusterError``."""

    @of_the_leader
    async def issue(self, role: AccessRole, *, valid_s: float = 0.0, label: str = "") -> tuple[str, str]:
        """A new token and its id; the manager keeps only its hash. ``valid_s`` 0: until revoked."""
        request = pb.IssueTokenRequest(role=_ROLES[role], valid_s=valid_s, label=label)
        with cluster_errors(self._address):
            answer = await self._admin.IssueToken(request, timeout=self._call_s)
        return answer.token, answer.token_id

    @of_the_leader
    async def listed(self) -> tuple[TokenInfo, ...]:
        """The tokens that are valid."""
        with cluster_errors(self._address):
            answer = await self._admin.ListTokens(pb.ListTokensRequest(), timeout=self._call_s)
            return each("tokens", token_info_from_proto, answer.tokens)

    @of_the_leader
    async def revoke(self, token_id: str) -> None:
        """Make a token void; sessions that it opened end at once."""
        with cluster_errors(self._address):
            await self._admin.RevokeToken(pb.RevokeTokenRequest(token_id=token_id), timeout=self._call_s)

    @of_the_leader
    async def revoke_worker(self, worker_id: str, reason: str = "") -> None:
        """Make a worker's credential void: its session ends, and what it held goes to others."""
        with cluster_errors(self._address):
            await self._admin.RevokeWorker(
                pb.RevokeWorkerRequest(worker_id=worker_id, reason=reason), timeout=self._call_s
            )
