"""Revocation of tokens and workers, for gRPC and REST."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import name_list
from embomatrix.rpc.status import NotFoundError, NotSignedInError

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate


class Revocation:
    """Revokes credentials and ends the sessions that they opened."""

    def __init__(self, sessions: ManagerRuntime, gate: Gate) -> None:
        self._sessions = sessions
        self._gate = gate

    async def revoke_worker(self, worker_id: str, reason: str) -> None:
        """Revoke the worker's credential, block its name until it joins again, and end its session.

        Raises NotFoundError for an unknown name, since a mistyped worker would keep working.
        """
        registry = self._sessions.registry
        if not self._gate.knows_worker(worker_id) and worker_id not in registry.sessions:
            raise NotFoundError(
                f"there is no worker {worker_id!r}, so none was revoked (connected: {name_list(registry.present)}): "
                "`embomatrix manager token list` lists all credentials"
            )
        await self._gate.revoke_worker(worker_id, reason)
        self._end(worker_id, reason)

    async def revoke_token(self, token_id: str) -> None:
        """Revoke the token and end every session that was opened with it."""
        await self._gate.revoke(token_id)
        for session in list(self._sessions.registry.sessions.values()):
            if session.credential_id == token_id:
                self._end(session.worker_id, "by the operator")

    def _end(self, worker_id: str, reason: str) -> None:
        session = self._sessions.registry.sessions.get(worker_id)
        if session is not None:
            refused = NotSignedInError(
                f"worker {worker_id} was revoked ({reason}): ask the operator for a new token to join"
            )
            self._sessions.end_session(session, "its credential was revoked", refused)
