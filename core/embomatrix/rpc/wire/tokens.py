"""Token roles, listed tokens, and their conversion to and from protobuf."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.wire.codec import converters, enum_member, enum_numbers


class AccessRole(StrEnum):
    """Role of a token. An admin may call everything."""

    JOIN = "join"
    """Registers one worker once, and is exchanged for that worker's credential."""
    WORKER = "worker"
    TRAINER = "trainer"
    VIEWER = "viewer"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class TokenInfo:
    """Listed token, without its secret."""

    token_id: str
    role: AccessRole
    label: str = ""
    left_s: float = 0.0
    """Remaining validity in seconds; 0: until revoked."""
    worker_id: str = ""
    """Worker that the credential belongs to."""


ROLE_NUMBERS: Final = enum_numbers(AccessRole, pb.Role, "ROLE")
_ROLES: Final[Mapping[int, AccessRole]] = {number: role for role, number in ROLE_NUMBERS.items()}

token_info_to_proto, token_info_from_proto = converters(
    TokenInfo, pb.TokenInfo, required_names=("token_id",), enums={"role": ROLE_NUMBERS}
)


def role_from_proto(number: int) -> AccessRole:
    return enum_member("role", _ROLES, number)
