"""Registry of worker sessions: presence, epochs and silence. Free of I/O; the clock is an argument."""

import functools
import itertools
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from embomatrix.manager.control.events import DrainChanged, Event, SuspicionChanged, WorkerJoined, WorkerLost
from embomatrix.rpc.status import (
    NotFoundError,
    OverloadedError,
    SessionLostError,
    SupersededError,
    UnknownSessionError,
)
from embomatrix.rpc.wire.values import Resources

LISTED: Final = 10
"""Names listed in one message at most."""


class WorkerStanding(StrEnum):
    """State of a worker as users see it."""

    READY = "ready"
    SUSPECT = "suspect"
    LOST = "lost"
    DRAINING = "draining"
    PAUSED = "paused"
    QUARANTINED = "quarantined"
    LEFT = "left"

    @property
    def is_gone(self) -> bool:
        """True for a worker that was connected and is lost or has left."""
        return self in (WorkerStanding.LOST, WorkerStanding.LEFT)


@dataclass(frozen=True, slots=True)
class LivenessLimits:
    """Limits of worker liveness, in seconds except for counts."""

    heartbeat_s: float = 1.0
    """Interval between two heartbeats of a worker in a small cluster."""
    heartbeats_per_s: float = 100.0
    """Heartbeats per second at most: the interval grows with the cluster."""
    longest_heartbeat_s: float = 7.5
    """Longest interval: a quarter of a lease's life, which heartbeats renew."""
    misses_suspect: int = 3
    """Silent intervals after which a worker gets no new leases."""
    lost_after_s: float = 10.0
    stream_grace_s: float = 1.0
    """Time in which a worker may reconnect after its stream broke."""
    remember_lost_s: float = 300.0
    """Time that a lost worker stays in the lists."""
    most_workers: int = 20_000
    """Workers that may be present. Further ones are refused."""
    most_lost: int = 1_000
    """Lost workers in the lists; of more, the first are forgotten."""


@dataclass(slots=True, eq=False)
class WorkerSession:
    """Registration of a worker. A newer registration of the same worker supersedes it."""

    worker_id: str
    boot_id: str
    session_id: str
    epoch: int
    resources: Resources
    last_seen_s: float
    standing: WorkerStanding = WorkerStanding.READY
    attached: bool = False
    detached_s: float | None = None
    reason: str = ""
    """Reason why it was lost, left, or is paused."""
    drained: bool = False
    """An operator drains it."""
    load: float = 0.0
    memory_used_mb: int = 0
    credential_id: str = ""
    """Token that opened the session. No other token may use it."""
    allowed_bundles: set[str] = field(default_factory=set)
    """Bundles that the worker may fetch: those of all scenes and leases that the session was given."""


class Registry:
    """Sessions by worker. ``new_id`` names each session, by default randomly.

    Methods return events for the state machines.
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
        self._sessions: dict[str, WorkerSession] = {}
        self._by_silence: OrderedDict[str, WorkerSession] = OrderedDict()
        """Sessions that are not lost, the longest silent first, which finds silent workers without a search."""
        self._detached: dict[str, WorkerSession] = {}
        self._lost: OrderedDict[str, WorkerSession] = OrderedDict()
        self._worker_of: dict[str, str] = {}
        self._epoch = first_epoch - 1
        self._first_epoch = first_epoch

    @property
    def sessions(self) -> Mapping[str, WorkerSession]:
        """Sessions by worker id; lost ones stay for a while."""
        return self._sessions

    @property
    def interval_s(self) -> float:
        """Seconds between two heartbeats of a worker in a cluster of this size."""
        fair_s = len(self._by_silence) / self._limits.heartbeats_per_s
        return max(self._limits.heartbeat_s, min(fair_s, self._limits.longest_heartbeat_s))

    @property
    def present(self) -> frozenset[str]:
        """Ids of the workers that are neither lost nor left."""
        return frozenset(self._by_silence)

    def register(
        self,
        worker_id: str,
        boot_id: str,
        resources: Resources,
        *,
        now_s: float,
    ) -> tuple[WorkerSession, list[Event]]:
        """Open a session and end an older one of the same worker. Leases survive only if the worker's process is the
        same. Raises OverloadedError.
        """
        before = self._sessions.get(worker_id)
        alive = before is not None and not before.standing.is_gone
        if not alive and len(self._by_silence) >= self._limits.most_workers:
            raise OverloadedError(
                f"{len(self._by_silence)} workers are connected: this manager serves no more; start another manager"
            )
        self._epoch += 1
        session = WorkerSession(
            worker_id=worker_id,
            boot_id=boot_id,
            session_id=self._new_id(),
            epoch=self._epoch,
            resources=resources,
            last_seen_s=now_s,
        )
        self._sessions[worker_id] = self._by_silence[worker_id] = session
        self._by_silence.move_to_end(worker_id)
        self._detached.pop(worker_id, None)
        self._lost.pop(worker_id, None)
        self._worker_of[session.session_id] = worker_id
        if before is not None:
            self._worker_of.pop(before.session_id, None)
            if alive and boot_id and before.boot_id == boot_id and before.resources == resources:
                # The same process under a new session still holds its leases and reports them in its full state.
                session.standing = before.standing
                return session, []
        lost = [WorkerLost(worker_id, "a newer session of the same worker took over")] if alive else []
        return session, [*lost, WorkerJoined(worker_id, resources)]

    def find(self, session_id: str, epoch: int) -> WorkerSession:
        """Return the live session. Raises SupersededError for an ended one, whose worker must stop.

        Raises SessionLostError if its worker was lost, and UnknownSessionError for a session of a former manager, whose worker
        keeps its leases and registers again.
        """
        if epoch < self._first_epoch:
            raise UnknownSessionError(
                "this manager took over from the one that opened the session: register again"
            )
        worker_id = self._worker_of.get(session_id, "")
        session = self._sessions.get(worker_id)
        if session is None or session.session_id != session_id or session.epoch != epoch:
            raise SupersededError(
                "this session is not known or was superseded by a newer one: register again"
            )
        if session.standing.is_gone:
            raise SessionLostError(f"worker {worker_id} is lost ({session.reason}): register again")
        return session

    def find_by_id(self, session_id: str) -> WorkerSession:
        """Return the live session, for calls without an epoch. Raises SupersededError for any other."""
        session = self._sessions.get(self._worker_of.get(session_id, ""))
        if session is None:
            raise SupersededError("this session is not known here or was superseded: register again")
        return self.find(session_id, session.epoch)

    def end(
        self, session: WorkerSession, reason: str, standing: WorkerStanding = WorkerStanding.LOST
    ) -> list[Event]:
        """End the session at once. Its leases are re-dispatched."""
        if session.standing.is_gone or self._sessions.get(session.worker_id) is not session:
            return []
        return [self._lose(session, reason, standing)]

    def attach(self, session: WorkerSession, *, now_s: float) -> None:
        """Note that the worker's stream is open. A suspect gets no leases before its first state arrives on it."""
        session.attached = True
        session.detached_s = None
        self._detached.pop(session.worker_id, None)
        self._note(session, now_s)

    def detach(self, session: WorkerSession, *, now_s: float) -> None:
        """Note that the worker's stream broke. The worker is lost unless it reconnects within the grace."""
        session.attached = False
        session.detached_s = now_s
        if self._by_silence.get(session.worker_id) is session:
            self._detached[session.worker_id] = session

    def heard(self, session: WorkerSession, *, now_s: float) -> list[Event]:
        """Note a sign of life."""
        self._note(session, now_s)
        if session.standing is not WorkerStanding.SUSPECT:
            return []
        session.standing = WorkerStanding.READY
        return [SuspicionChanged(session.worker_id, suspect=False)]

    def drain(self, worker_id: str) -> list[Event]:
        session = self._session_of(worker_id)
        session.drained, session.standing = True, WorkerStanding.DRAINING
        return [DrainChanged(worker_id, drained=True)]

    def resume(self, worker_id: str) -> list[Event]:
        """Cancel an operator's drain. The worker's next state says whether it drains on its own."""
        session = self._session_of(worker_id)
        session.drained, session.standing = False, WorkerStanding.READY
        return [DrainChanged(worker_id, drained=False)]

    def note_state(self, session: WorkerSession, *, draining: bool, paused: str) -> None:
        """Note the worker's own report that it drains or is paused."""
        if draining or session.drained:
            session.standing = WorkerStanding.DRAINING
        else:
            session.standing = WorkerStanding.PAUSED if paused else WorkerStanding.READY
        session.reason = paused

    def excuse_silence(self, seconds: float, *, now_s: float) -> None:
        """Excuse the silence of all workers during ``seconds`` in which the manager did not run."""
        for session in self._by_silence.values():
            session.last_seen_s = min(session.last_seen_s + seconds, now_s)
        for session in self._detached.values():
            if session.detached_s is not None:
                session.detached_s = min(session.detached_s + seconds, now_s)

    def tick(self, *, now_s: float) -> list[Event]:
        """Suspect silent workers, lose those that stayed silent, and forget old lost ones."""
        self._forget_lost(now_s)
        events: list[Event] = []
        suspect_s = self._limits.misses_suspect * self.interval_s
        for session in self._silent_for(suspect_s, now_s):
            silent_s = now_s - session.last_seen_s
            if silent_s >= max(self._limits.lost_after_s, suspect_s):
                events.append(self._lose(session, f"silent for {silent_s:.1f} s"))
            elif session.standing is WorkerStanding.READY:
                session.standing = WorkerStanding.SUSPECT
                events.append(SuspicionChanged(session.worker_id, suspect=True))
        for session in list(self._detached.values()):
            if session.detached_s is not None and now_s - session.detached_s >= self._limits.stream_grace_s:
                if session.standing is WorkerStanding.DRAINING:
                    events.append(self._lose(session, "it drained and left", WorkerStanding.LEFT))
                else:
                    events.append(self._lose(session, "its connection broke and it did not reconnect"))
        return events

    def _session_of(self, worker_id: str) -> WorkerSession:
        session = self._sessions.get(worker_id)
        if session is None:
            raise NotFoundError(
                f"there is no worker {worker_id!r} (connected: {name_list(self.present)}): check its name with "
                "`embomatrix cluster workers`"
            )
        if session.standing.is_gone:
            raise NotFoundError(f"worker {worker_id!r} is gone ({session.reason}): restart it on its machine")
        return session

    def _note(self, session: WorkerSession, now_s: float) -> None:
        session.last_seen_s = now_s
        if self._by_silence.get(session.worker_id) is session:
            self._by_silence.move_to_end(session.worker_id)

    def _silent_for(self, seconds: float, now_s: float) -> list[WorkerSession]:
        silent = itertools.takewhile(
            lambda session: now_s - session.last_seen_s >= seconds, self._by_silence.values()
        )
        return list(silent)

    def _forget_lost(self, now_s: float) -> None:
        while self._lost:
            session = next(iter(self._lost.values()))
            recent = now_s - session.last_seen_s <= self._limits.remember_lost_s
            if recent and len(self._lost) <= self._limits.most_lost:
                return
            del self._lost[session.worker_id], self._sessions[session.worker_id]
            self._worker_of.pop(session.session_id, None)

    def _lose(
        self, session: WorkerSession, reason: str, standing: WorkerStanding = WorkerStanding.LOST
    ) -> WorkerLost:
        session.standing = standing
        session.reason = reason
        del self._by_silence[session.worker_id]
        self._detached.pop(session.worker_id, None)
        self._lost[session.worker_id] = session
        return WorkerLost(session.worker_id, reason)


def name_list(worker_ids: Iterable[str]) -> str:
    """Return the first names for a message, and the number of others."""
    names = sorted(worker_ids)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (", ".join(names[:LISTED]) or "none") + more
