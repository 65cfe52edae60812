"""Membership of a worker: its manager, name and credential, and the file that keeps them after joining once."""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.trust import Invitation, fetch_ca, read_ca, read_token
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.worker.host.settings import WorkerSettings


@dataclass(frozen=True, slots=True)
class Membership:
    """Identity at a manager. ``ca`` is the certificate (PEM) of the authority to trust; empty without TLS."""

    manager: str
    """HOST:PORT, or several with commas between them."""
    name: str
    token: str = field(default="", repr=False)
    ca: bytes = b""
    joining: bool = False
    """True if the token is for joining: the manager answers with a credential that replaces it."""


class MembershipFile:
    """File with the credential that a manager gave for one token, readable by its owner only."""

    def __init__(self, folder: Path, token: str) -> None:
        # The file name must not reveal the token, and a token may contain any character.
        name = hashlib.sha256(token.encode()).hexdigest()[:16]
        self._path = folder.expanduser() / f"member-{name}.json"

    def read(self) -> Membership | None:
        """Read the membership; None without a file. Raise InvalidRequestError for an unreadable file."""
        try:
            kept = parse_json(self._path.read_bytes())
            return Membership(kept["manager"], kept["name"], kept["credential"], kept["ca"].encode("ascii"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidRequestError(
                f"{self._path} can't be read ({error}): remove it, and join with a new token"
            ) from error

    def keep(self, membership: Membership) -> None:
        """Write the file; only its owner can read it from the first byte."""
        self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        kept = {
            "manager": membership.manager,
            "name": membership.name,
            "credential": membership.token,
            "ca": membership.ca.decode("ascii"),
        }
        write_whole(self._path, json.dumps(kept).encode("ascii"), mode=0o600)


def authority_of(manager: str, folder: Path) -> bytes:
    """Return the authority of a manager that a worker of this machine has joined; empty without one."""
    for path in sorted(folder.expanduser().glob("member-*.json")):
        # Whoever joins with a damaged file is told of it; here it is no reason to check nothing.
        with contextlib.suppress(
            OSError, ValueError, KeyError, TypeError, AttributeError, InvalidRequestError
        ):
            kept = parse_json(path.read_bytes())
            if manager in Managers(kept["manager"]).addresses:
                return bytes(kept["ca"].encode("ascii"))
    return b""


async def membership_of(settings: WorkerSettings) -> Membership:
    """Return the membership of these settings; an earlier credential for the same token takes precedence.

    Raise ClusterError for an invalid invitation, and for a manager that can't be reached or does not match the invitation.
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
