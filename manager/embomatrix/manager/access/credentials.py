"""Credentials of tokens: hashes, roles and expiry. Free of I/O; the clock is an argument.

A token is ``ID.SECRET``. The public id finds the credential. The secret has 256 random bits, so a plain hash is safe.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import msgspec

from embomatrix.manager.store.protocol import NamespaceRow
from embomatrix.rpc.status import (
    InvalidRequestError,
    NotAllowedError,
    NotFoundError,
    NotSignedInError,
    OverloadedError,
)
from embomatrix.rpc.wire.tokens import AccessRole, TokenInfo

LONGEST_JOIN_S: Final = 86_400.0
"""Longest validity of a join token, which is meant for immediate use."""
REMEMBERED_S: Final = 30 * 86_400.0
"""Time that expired credentials are kept, to report that they expired."""
LIMIT: Final = 100_000
LABEL_LENGTH: Final = 200
NO_TOKEN: Final = (
    "missing or unknown token: pass --token, or set EMBOMATRIX_TOKEN to a token of this manager; to join a worker, "
    "ask the operator for an invitation (`embomatrix manager token issue --role join`)"
)
_REPLACED: Final = "its worker requested another before it used this one"
_NOTHING: Final = hashlib.sha256(b"").hexdigest()


@dataclass(frozen=True, slots=True)
class Credential:
    """Token without its secret. Times are seconds since the epoch on the manager's clock."""

    token_id: str
    role: AccessRole
    secret_hash: str
    label: str = ""
    expires_s: float = 0.0
    """0: never."""
    worker_id: str = ""
    """Worker that a credential belongs to, or that used a join token."""
    boot_id: str = ""
    """Process that used a join token."""
    joined_by: str = ""
    """Id of the join token that was exchanged for this credential."""
    revoked: str = ""
    """Reason of the revocation; empty while valid."""

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Credential:
        """Return the credential of stored fields. Raises ValueError or TypeError for other fields or types."""
        cls(**fields)  # refuses unknown fields
        return msgspec.convert(fields, cls)

    def row(self) -> NamespaceRow:
        return NamespaceRow(self.token_id, json.dumps(asdict(self), separators=(",", ":")).encode())

    def named(self) -> str:
        """Return the token's name for messages."""
        return f"the token {self.token_id}" + (f" ({self.label})" if self.label else "")


class CredentialBook:
    """All credentials of a cluster. Changing methods return credentials to store, and ``keep`` adds them afterwards."""

    def __init__(self, credentials: Iterable[Credential] = ()) -> None:
        self._by_id: dict[str, Credential] = {}
        self._of_worker: dict[str, dict[str, Credential]] = {}
        """Credentials of role worker by worker name, then by id."""
        self._seen: set[str] = set()
        """Credentials that were used since this process started."""
        self.keep(*credentials)

    def __contains__(self, token_id: str) -> bool:
        return token_id in self._by_id

    def keep(self, *credentials: Credential) -> None:
        for credential in credentials:
            self._by_id[credential.token_id] = credential
            if credential.role is AccessRole.WORKER and credential.worker_id:
                self._of_worker.setdefault(credential.worker_id, {})[credential.token_id] = credential

    def find(self, token: str, *, now_s: float) -> Credential:
        """Return the valid credential of a token. Raises NotSignedInError with the reason."""
        token_id, _, secret = token.partition(".")
        credential = self._by_id.get(token_id)
        # Compared even without a credential, so that the time of the answer reveals nothing.
        known = credential.secret_hash if credential is not None else _NOTHING
        fits = hmac.compare_digest(hash_of(secret), known)
        if credential is None or not fits or not secret:
            raise NotSignedInError(NO_TOKEN)
        if credential.revoked:
            raise NotSignedInError(
                f"{credential.named()} was revoked ({credential.revoked}): ask the operator for another"
            )
        if credential.expires_s and now_s >= credential.expires_s:
            raise NotSignedInError(
                f"{credential.named()} expired: ask the operator for another (`embomatrix manager token issue`)"
            )
        self._seen.add(token_id)
        return credential

    def issue(
        self, role: AccessRole, *, valid_s: float, label: str, now_s: float, worker_id: str = ""
    ) -> tuple[Credential, str]:
        """Return a new credential and its token. ``valid_s`` 0: until revoked, or one day for a join token."""
        if not 0.0 <= valid_s < float("inf"):
            raise InvalidRequestError(f"a token's validity is {valid_s} s: expected 0 or more")
        if role is AccessRole.JOIN:
            valid_s = valid_s or LONGEST_JOIN_S
            if valid_s > LONGEST_JOIN_S:
                raise InvalidRequestError(
                    f"a join token cannot be valid for {valid_s:.0f} s: at most {LONGEST_JOIN_S:.0f} s"
                )
        if len(self._by_id) >= LIMIT:
            raise OverloadedError(
                f"{len(self._by_id)} tokens exist, and at most {LIMIT} may: start the manager anew, which forgets expired ones"
            )
        secret = secrets.token_urlsafe(32)
        credential = Credential(
            token_id=_new_id(),
            role=role,
            secret_hash=hash_of(secret),
            label=label[:LABEL_LENGTH],
            expires_s=now_s + valid_s if valid_s else 0.0,
            worker_id=worker_id,
        )
        return credential, f"{credential.token_id}.{secret}"

    def redeem(
        self, join: Credential, worker_id: str, boot_id: str, *, now_s: float
    ) -> tuple[tuple[Credential, ...], str]:
        """Exchange a join token. Return the changed credentials, the worker's own first, and its token.

        A join token is valid for one worker. The same process may repeat the exchange until it uses the new
        credential, since the answer may have been lost. Raises NotSignedInError or NotAllowedError.
        """
        changed: tuple[Credential, ...] = ()
        if join.worker_id:
            given = [
                c
                for c in self._of_worker.get(join.worker_id, {}).values()
                if c.joined_by == join.token_id and c.revoked != _REPLACED
            ]
            again = (join.worker_id, join.boot_id) == (worker_id, boot_id) and bool(boot_id)
            if not again or any(c.revoked or c.token_id in self._seen for c in given):
                raise NotSignedInError(
                    f"this join token was used already, by worker {join.worker_id}: ask the operator for another "
                    "(`embomatrix manager token issue --role join`)"
                )
            changed = tuple(replace(c, revoked=_REPLACED) for c in given)
        holder = self._holder(worker_id)
        if holder is not None and holder not in changed and holder.joined_by != join.token_id:
            raise NotAllowedError(
                f"another machine joined as worker {worker_id}: pass another --name, or have its credential revoked first"
            )
        own, token = self.issue(
            AccessRole.WORKER, valid_s=0.0, label=join.label, now_s=now_s, worker_id=worker_id
        )
        own = replace(own, joined_by=join.token_id)
        used = replace(join, worker_id=worker_id, boot_id=boot_id)
        return (own, used, *changed), token

    def check_name(self, credential_id: str, bound_to: str, worker_id: str) -> None:
        """Raise NotAllowedError if a worker's token may not register under this name."""
        if bound_to and bound_to != worker_id:
            raise NotAllowedError(
                f"this credential belongs to worker {bound_to}: it can't register as {worker_id}"
            )
        holder = self._holder(worker_id)
        if not bound_to and holder is not None and holder.token_id != credential_id:
            raise NotAllowedError(
                f"the name {worker_id} belongs to a machine that joined with its own credential: pass another --name"
            )
        if not bound_to and any(c.revoked for c in self._of_worker.get(worker_id, {}).values()):
            raise NotAllowedError(
                f"worker {worker_id} was revoked: let it join again (`embomatrix manager token issue --role join`)"
            )

    def revoke(self, token_id: str, reason: str) -> Credential:
        """Return the revoked credential. Raises NotFoundError."""
        credential = self._by_id.get(token_id)
        if credential is None:
            raise NotFoundError(
                f"there is no token {token_id[:40]!r}: `embomatrix manager token list` shows them"
            )
        return replace(credential, revoked=credential.revoked or reason)

    def revoke_worker(self, worker_id: str, reason: str) -> Credential:
        """Return the worker's revoked credential. For a worker with a shared token, it only blocks the name."""
        own = self._holder(worker_id)
        if own is not None:
            return replace(own, revoked=reason)
        return Credential(_new_id(), AccessRole.WORKER, _NOTHING, worker_id=worker_id, revoked=reason)

    def knows_worker(self, worker_id: str) -> bool:
        """Return True if a credential, valid or revoked, belongs to this name."""
        return worker_id in self._of_worker

    def infos(self, *, now_s: float) -> tuple[TokenInfo, ...]:
        """Return the valid tokens: not expired, revoked or used up."""
        return tuple(
            TokenInfo(c.token_id, c.role, c.label, c.expires_s - now_s if c.expires_s else 0.0, c.worker_id)
            for c in self._by_id.values()
            if not c.revoked
            and not (c.expires_s and now_s >= c.expires_s)
            and not (c.role is AccessRole.JOIN and c.worker_id)
        )

    def _holder(self, worker_id: str) -> Credential | None:
        """Return the one valid credential of this name."""
        return next((c for c in self._of_worker.get(worker_id, {}).values() if not c.revoked), None)


def _new_id() -> str:
    return secrets.token_hex(6)


def hash_of(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def is_remembered(credential: Credential, *, now_s: float) -> bool:
    """Return True if the credential must be kept. Revoked credentials without expiry must be kept to stay revoked."""
    return not credential.expires_s or now_s < credential.expires_s + REMEMBERED_S
