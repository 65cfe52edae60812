"""Access control of every call: stored credentials and role checks."""

import asyncio
import hmac
import logging
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import grpc

from embomatrix.manager.access.credentials import NO_TOKEN, Credential, CredentialBook, is_remembered
from embomatrix.manager.access.folder import AccessError
from embomatrix.manager.access.roles import OPEN, may_call, who_may
from embomatrix.manager.store.protocol import Namespace, NamespaceRow, StateError, StateStore, readable
from embomatrix.rpc.channel import TOKEN_KEY, token_of
from embomatrix.rpc.status import (
    ClusterError,
    NotAllowedError,
    NotSignedInError,
    PreconditionError,
    UnavailableError,
)
from embomatrix.rpc.wire.tokens import AccessRole, TokenInfo
from embomatrix.world.json_text import parse_json

logger = logging.getLogger(__name__)

SHARED_ID: Final = "shared"
"""Id of the shared token of ``--token``, distinct from all issued ids."""


@dataclass(frozen=True, slots=True)
class Caller:
    """Caller, identified by its token. Only the token that opened a session may use it."""

    role: AccessRole
    token_id: str = ""
    worker_id: str = ""
    """Worker that the credential belongs to; empty for shared tokens."""


ANYONE: Final = Caller(AccessRole.ADMIN)
"""Caller of a manager without tokens."""


class Gate:
    """Access control of one cluster. ``shared_token`` has the role of an admin; ``guarded`` False accepts every
    caller.
    """

    def __init__(self, store: StateStore, *, guarded: bool, shared_token: str = "") -> None:
        self._store = store
        self._guarded = guarded
        self._shared = shared_token
        self._book = CredentialBook()
        self._lock = asyncio.Lock()

    async def open(self, first: Iterable[Credential] = ()) -> None:
        """Load stored credentials and store new first tokens. Raises StateError.

        Raises AccessError for a shared token that was issued for a role, since it would become an admin's.
        """
        now_s = time.time()
        known = [_credential_of(row) for row in await self._store.rows(Namespace.CREDENTIALS)]
        self._book.keep(*(credential for credential in known if is_remembered(credential, now_s=now_s)))
        fresh = [credential for credential in first if credential.token_id not in self._book]
        if fresh:
            await self._store.put_rows(Namespace.CREDENTIALS, [credential.row() for credential in fresh])
            self._book.keep(*fresh)
        if self._shared.partition(".")[0] in self._book:
            raise AccessError(
                "--token, or EMBOMATRIX_TOKEN, holds a token that this cluster issued for a role, and would grant it the "
                "role of an admin: leave it out, or pass another secret"
            )

    def caller(self, token: str) -> Caller:
        """Return the caller of a token. Raises NotSignedInError."""
        if not self._guarded:
            return ANYONE
        if self._shared and hmac.compare_digest(token.encode(), self._shared.encode()):
            return Caller(AccessRole.ADMIN, SHARED_ID)
        if not token:
            raise NotSignedInError(NO_TOKEN)
        found = self._book.find(token, now_s=time.time())
        return Caller(found.role, found.token_id, found.worker_id if found.role is AccessRole.WORKER else "")

    def refusal(self, method: str, headers: Sequence[str]) -> ClusterError | None:
        """Return the reason to refuse the method with these ``authorization`` headers; None if it is allowed."""
        if method in OPEN and not headers:
            return None
        try:
            caller = self.caller(the_token(headers))
        except NotSignedInError as error:
            return error
        if method in OPEN or may_call(caller.role, method):
            return None
        return NotAllowedError(
            f"a token of the role {caller.role} may not call {method.rpartition('/')[2]}: it needs {who_may(method)}"
        )

    def caller_of(self, context: grpc.aio.ServicerContext) -> Caller:
        """Return the caller of a gRPC call. Raises NotSignedInError."""
        return self.caller(_token_in(context))

    async def admit(
        self, context: grpc.aio.ServicerContext, join_token: str, worker_id: str, boot_id: str
    ) -> tuple[str, str]:
        """Admit a worker under this name, by the token of its call or the join token of its request.

        Return the id of its token from now on, and the token of its new credential; empty if it keeps its own.
        """
        token = _token_in(context) or join_token
        caller = self.caller(token)
        if not may_call(caller.role, _REGISTER):
            raise NotAllowedError(
                f"a token of the role {caller.role} may not register workers: it needs {who_may(_REGISTER)}"
            )
        if caller.role is AccessRole.JOIN:
            return await self._join(token, worker_id, boot_id)
        if self._guarded:
            self._book.check_name(caller.token_id, caller.worker_id, worker_id)
        return caller.token_id, ""

    def check_session(self, context: grpc.aio.ServicerContext, worker_id: str, credential_id: str) -> None:
        """Raise NotAllowedError unless the caller's credential is the one that opened the worker's session."""
        if self.caller_of(context).token_id != credential_id:
            raise NotAllowedError(
                f"the session of worker {worker_id} was opened with another credential: register again with this one"
            )

    async def issue(self, role: AccessRole, *, valid_s: float, label: str) -> tuple[str, str]:
        """Return a new token and its id."""
        self._need_guard()
        async with self._lock:
            credential, token = self._book.issue(role, valid_s=valid_s, label=label, now_s=time.time())
            await self._keep(credential)
        logger.info("token issued token=%s role=%s label=%s", credential.token_id, role, credential.label)
        return token, credential.token_id

    async def revoke(self, token_id: str) -> None:
        self._need_guard()
        if token_id == SHARED_ID:
            raise PreconditionError(
                "the shared token of --token can't be revoked: start the manager with another"
            )
        async with self._lock:
            await self._keep(self._book.revoke(token_id, "by the operator"))
        logger.info("token revoked token=%s", token_id)

    def knows_worker(self, worker_id: str) -> bool:
        """Return True if the name has a credential or is blocked."""
        self._need_guard()
        return self._book.knows_worker(worker_id)

    async def revoke_worker(self, worker_id: str, reason: str) -> None:
        self._need_guard()
        async with self._lock:
            await self._keep(self._book.revoke_worker(worker_id, reason))
        logger.info("worker revoked worker=%s: %s", worker_id, reason)

    def infos(self) -> tuple[TokenInfo, ...]:
        return self._book.infos(now_s=time.time())

    async def _join(self, token: str, worker_id: str, boot_id: str) -> tuple[str, str]:
        async with self._lock:
            now_s = time.time()
            # Looked up again: another process may have used the token during the wait for the lock.
            changed, own = self._book.redeem(
                self._book.find(token, now_s=now_s), worker_id, boot_id, now_s=now_s
            )
            await self._keep(*changed)
        logger.info(
            "worker joined worker=%s token=%s by=%s", worker_id, changed[0].token_id, changed[0].joined_by
        )
        return changed[0].token_id, own

    async def _keep(self, *credentials: Credential) -> None:
        """Store the credentials before they take effect, so that grants and revocations survive a restart."""
        try:
            await self._store.put_rows(
                Namespace.CREDENTIALS, [credential.row() for credential in credentials]
            )
        except StateError as error:
            raise UnavailableError(str(error)) from error
        self._book.keep(*credentials)

    def _need_guard(self) -> None:
        if not self._guarded:
            raise PreconditionError(
                "this manager requires no tokens, so none can be issued or revoked: run "
                "`embomatrix manager init` for its data folder and restart it"
            )


_REGISTER: Final = "/embomatrix.proto.v1.WorkerService/Register"


def the_token(headers: Sequence[str]) -> str:
    """Return the token of the ``authorization`` headers of one call; empty without any.

    Raises NotSignedInError for several headers, since proxies and servers disagree about the one that counts.
    """
    if len(headers) > 1:
        raise NotSignedInError(f"found {len(headers)} authorization headers: send one")
    return token_of(headers[0]) if headers else ""


def _token_in(context: grpc.aio.ServicerContext) -> str:
    return the_token([value for key, value in context.invocation_metadata() or () if key == TOKEN_KEY])


def _credential_of(row: NamespaceRow) -> Credential:
    with readable(f"the credential {row.key!r}"):
        return Credential.of(parse_json(row.payload))
