"""What tokens are good for."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class AccessRole(StrEnum):
    """An admin may do everything."""

    JOIN = "join"
    """Registers one worker, once; it is changed for a credential of that worker."""
    WORKER = "worker"
    TRAINER = "trainer"
    VIEWER = "viewer"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class TokenInfo:
    """A token as people see it: never the token itself."""

    token_id: str
    role: AccessRole
    label: str = ""
    left_s: float = 0.0
    """Seconds that it is still valid; 0: until revoked."""
    worker_id: str = ""
    """The worker that the credential belongs to."""
