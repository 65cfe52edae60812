"""Sessions of workers: who is there, under which epoch, and who fell silent. Decisions only; the clock is an argument."""

from __future__ import annotations

import functools
import secrets
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from embomatrix.manager.events import (
    Event,
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerRecovered,
    WorkerSuspected,
)
from embomatrix.rpc.status import NotFoundError, SupersededError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.rpc.values import Resources


class Standing(StrEnum):
    """What a person sees of a worker."""

    READY = "ready"
    SUSPECT = "suspect"
    LOST = "lost"
    DRAINING = "draining"


@dataclass(frozen=True, slots=True)
class LivenessLimits:
    """When a worker is heard, doubted, and given up; seconds, except for counts."""

    heartbeat_s: float = 1.0
    """Between two heartbeats of a worker, in a small cluster."""
    heartbeats_per_s: float = 100.0
    """The interval grows with the cluster, so that the manager gets no more than this."""
    misses_suspect: int = 3
    """Intervals of silence after which a worker gets no new leases."""
    lost_after_s: float = 10.0
    stream_grace_s: float = 1.0
    """A worker whose session stream broke may come back within this time."""
    remember_lost_s: float = 300.0
    """How long a lost worker stays in the lists for people to see."""


@dataclass(slots=True, eq=False)
class Session:
    """One registration of a worker. A newer one of the same worker supersedes it."""

    worker_id: str
    boot_id: str
    session_id: str
    epoch: int
    resources: Resources
    last_seen_s: float
    standing: Standing = Standing.READY
    attached: bool = False
    detached_s: float | None = None
    reason: str = ""
    """Why it was lost."""
    load: float = 0.0
    memory_used_mb: int = 0


class Registry:
    """Sessions by worker; ``new_id`` names each, by default as nobody can guess.

    Methods return what the state machines should hear of.
    """

    def __init__(
        self,
        limits: LivenessLimits,
        *,
        first_epoch: int = 1,
        new_id: Callable[[], str] | None = None,
    ) -> None:
        self._limits = limits
        self._new_id = new_id or functools.partial(secrets.token_hex, 8)
        self._sessions: dict[str, Session] = {}
        self._worker_of: dict[str, str] = {}
        self._epoch = first_epoch - 1

    @property
    def sessions(self) -> Mapping[str, Session]:
        """By worker id; lost ones stay for a while."""
        return self._sessions

    @property
    def interval_s(self) -> float:
        """Seconds between two heartbeats of a worker in a cluster of this size."""
        live = sum(session.standing is not Standing.LOST for session in self._sessions.values())
        return max(self._limits.heartbeat_s, live / self._limits.heartbeats_per_s)

    def register(
        self, worker_id: str, boot_id: str, resources: Resources, *, now_s: float
    ) -> tuple[Session, list[Event]]:
        """Open a session; an older one of the same worker ends. The same process keeps its leases, another one loses them."""
        before = self._sessions.get(worker_id)
        alive = before is not None and before.standing is not Standing.LOST
        self._epoch += 1
        session = Session(
            worker_id=worker_id,
            boot_id=boot_id,
            session_id=self._new_id(),
            epoch=self._epoch,
            resources=resources,
            last_seen_s=now_s,
        )
        self._sessions[worker_id] = session
        self._worker_of[session.session_id] = worker_id
        if before is not None:
            self._worker_of.pop(before.session_id, None)
            if alive and boot_id and before.boot_id == boot_id and before.resources == resources:
                # The same process under a new session: it still holds its leases, and its full state will tell which.
                session.standing = before.standing
                return session, []
        lost = [WorkerLost(worker_id, "a newer session of the same worker took over")] if alive else []
        return session, [*lost, WorkerJoined(worker_id, resources)]

    def find(self, session_id: str, epoch: int) -> Session:
        """The live session of that name; raises ``SupersededError`` for one that ended, so that its worker stops."""
        worker_id = self._worker_of.get(session_id, "")
        session = self._sessions.get(worker_id)
        if session is None or session.session_id != session_id or session.epoch != epoch:
            raise SupersededError(
                "this session is not known or was superseded by a newer one: register again"
            )
        if session.standing is Standing.LOST:
            raise SupersededError(f"worker {worker_id} was given up ({session.reason}): register again")
        return session

    def attach(self, session: Session, *, now_s: float) -> list[Event]:
        """The worker's stream is open."""
        session.attached = True
        session.detached_s = None
        return self.heard(session, now_s=now_s)

    def detach(self, session: Session, *, now_s: float) -> None:
        """The worker's stream broke; unless it comes back within the grace, the worker is lost."""
        session.attached = False
        session.detached_s = now_s

    def heard(self, session: Session, *, now_s: float) -> list[Event]:
        """Any sign of life."""
        session.last_seen_s = now_s
        if session.standing is not Standing.SUSPECT:
            return []
        session.standing = Standing.READY
        return [WorkerRecovered(session.worker_id)]

    def drain(self, worker_id: str) -> list[Event]:
        """Take a worker out of service once it has finished what it holds."""
        session = self._sessions.get(worker_id)
        if session is None or session.standing is Standing.LOST:
            known = ", ".join(sorted(self._sessions)) or "none"
            raise NotFoundError(f"there is no worker {worker_id!r}: connected are {known}")
        session.standing = Standing.DRAINING
        return [WorkerDrained(worker_id)]

    def draining(self, session: Session) -> None:
        """The worker itself says that it will leave."""
        session.standing = Standing.DRAINING

    def tick(self, *, now_s: float) -> list[Event]:
        """Suspect the silent, give up the lost, forget the long gone."""
        events: list[Event] = []
        suspect_s = self._limits.misses_suspect * self.interval_s
        for session in list(self._sessions.values()):
            silent_s = now_s - session.last_seen_s
            if session.standing is Standing.LOST:
                if silent_s > self._limits.remember_lost_s:
                    del self._sessions[session.worker_id]
                    self._worker_of.pop(session.session_id, None)
            elif silent_s >= max(self._limits.lost_after_s, suspect_s):
                events.append(self._lose(session, f"not heard of for {silent_s:.1f} s"))
            elif session.detached_s is not None and now_s - session.detached_s >= self._limits.stream_grace_s:
                left = session.standing is Standing.DRAINING
                reason = "it drained and left" if left else "its connection broke and it did not come back"
                events.append(self._lose(session, reason))
            elif silent_s >= suspect_s and session.standing is Standing.READY:
                session.standing = Standing.SUSPECT
                events.append(WorkerSuspected(session.worker_id))
        return events

    def _lose(self, session: Session, reason: str) -> WorkerLost:
        session.standing = Standing.LOST
        session.reason = reason
        return WorkerLost(session.worker_id, reason)
