"""As whom a worker speaks to which manager, and the file that remembers it: a spare PC joins once and is known from then on."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.trust import Invitation, fetch_ca, read_ca, read_token

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.worker.host.settings import WorkerSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Membership:
    """``ca`` is the certificate (PEM) of the authority to trust; empty without TLS."""

    manager: str
    """HOST:PORT, or several with commas between them."""
    name: str
    token: str = field(default="", repr=False)
    ca: bytes = b""
    joining: bool = False
    """The token is one to join with: the manager will answer with a credential to show instead."""


class MembershipFile:
    """Remembers what became of one token: the credential that the manager gave for it, for the owner's eyes only."""

    def __init__(self, folder: Path, token: str) -> None:
        # The file's name must not betray the token, and a token may hold any character.
        name = hashlib.sha256(token.encode()).hexdigest()[:16]
        self._path = folder.expanduser() / f"member-{name}.json"

    def read(self) -> Membership | None:
        """What was kept, if anything was. Raises InvalidRequestError for a file that can't be read."""
        try:
            kept = json.loads(self._path.read_bytes())
            return Membership(kept["manager"], kept["name"], kept["credential"], kept["ca"].encode("ascii"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidRequestError(
                f"{self._path} can't be read ({error}): remove it, and join with a new token"
            ) from error

    def keep(self, membership: Membership) -> None:
        """Written aside and renamed; readable by the owner alone from its first byte on."""
        self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        part = self._path.with_suffix(".part")
        part.unlink(missing_ok=True)
        kept = {
            "manager": membership.manager,
            "name": membership.name,
            "credential": membership.token,
            "ca": membership.ca.decode("ascii"),
        }
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            json.dump(kept, file)
        part.replace(self._path)


async def membership_of(settings: WorkerSettings) -> Membership:
    """As whom these settings say that the worker speaks; what it was given for its token before comes first.

    Raises ClusterError: an invitation that is none, a manager that can't be reached or is not the one of the invitation.
    """
    if settings.join:
        invitation = Invitation.parse(settings.join)
        kept = MembershipFile(settings.state_dir, invitation.token).read()
        if kept is not None:
            return replace(kept, manager=invitation.address)
        ca = await fetch_ca(invitation)
        return Membership(invitation.address, settings.name, invitation.token, ca, joining=True)
    token = read_token(settings.token)
    kept = MembershipFile(settings.state_dir, token).read() if token else None
    return kept or Membership(settings.manager, settings.name, token, read_ca(settings.ca))
