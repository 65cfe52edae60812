"""Worker daemon: it keeps a session with the manager across restarts, and the slots busy meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import os
import secrets
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.host.backoff import Backoff
from embomatrix.host.limits import MIB
from embomatrix.rpc.logs import LogTail, bind, hide
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import (
    ClusterError,
    DeadlineError,
    InternalError,
    OverloadedError,
    SessionLostError,
    SupersededError,
    UnavailableError,
    UnknownSessionError,
)
from embomatrix.rpc.wire.bounds import RESULT_TEXT, SENTENCE, check_result
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.leases import LeaseResult
from embomatrix.rpc.wire.session import lease_result_to_proto
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure, Resources
from embomatrix.worker.host.machine import HostMachine, HostMeter, Probe
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.cache import BundleCache
from embomatrix.worker.link.membership import Membership, MembershipFile
from embomatrix.worker.link.outbox import ResultOutbox
from embomatrix.worker.link.session import FETCH_S, ManagerSession, Registration, register
from embomatrix.worker.link.status import StatusFile, WorkerStatus, daemon_pids
from embomatrix.worker.slots.pool import SlotPool
from embomatrix.worker.slots.processes import SIMULATOR_PROGRAM
from embomatrix.worker.slots.residents import LoadError, SlotLimits
from embomatrix.worker.slots.yielding import MemoryWatch, OwnerWatch

if TYPE_CHECKING:
    import numpy as np

logger = logging.getLogger(__name__)

FIRST_WAIT_S: Final = 0.2
LONGEST_WAIT_S: Final = 3.0
"""Longest wait between two attempts to connect: a restarted manager has its workers within five seconds."""
SESSION_SHOWN: Final = 6
"""Characters of a session id in log lines. The full id would let a reader impersonate this worker."""
FENCE_CHECK_S: Final = 0.5
FETCH_AGAIN_S: Final = 0.25
"""Wait before a bundle is requested again after a broken connection."""
DRAIN_RETRY_S: Final = 1.0
"""Longest wait between attempts to deliver the last results of a draining worker."""
CONFLICTS: Final = 3
"""More session conflicts than this within the window mean that another worker has the same name."""
CONFLICT_WINDOW_S: Final = 60.0
_PASSING: Final = (UnavailableError, DeadlineError, OverloadedError, InternalError)
"""Errors after which the daemon connects again. Others need a user."""


class Daemon:
    """One worker. ``run`` returns after it has left, and raises ClusterError for errors that a retry can't fix."""

    def __init__(
        self,
        settings: WorkerSettings,
        resources: Resources,
        rng: np.random.Generator,
        *,
        program: tuple[str, ...] = SIMULATOR_PROGRAM,
        membership: Membership | None = None,
        probe: Probe | None = None,
        log_tail: LogTail | None = None,
    ) -> None:
        self._meter = HostMeter()
        self._log_tail = log_tail if settings.send_log else None
        self._settings = settings
        self._membership = membership or Membership(settings.manager, settings.name, settings.token)
        self._resources = resources
        self._boot_id = secrets.token_hex(8)
        self._managers = Managers(self._membership.manager)
        # Each of several managers is tried as often as a single one would be.
        self._backoff = Backoff(
            FIRST_WAIT_S, LONGEST_WAIT_S / self._managers.count, jitter=lambda: float(rng.uniform(0.8, 1.2))
        )
        self._outbox = ResultOutbox()
        self._cache = self._opened_cache()
        self._pool = self._new_pool(program)
        self._owner_watch = OwnerWatch(
            settings.preferences,
            probe or HostMachine(lambda: daemon_pids(settings.state_dir)),
            self._pool,
            on_pause=self._pause,
            on_hand_back=self._hand_back,
        )
        self._started_s = time.time()
        self._connected_since_s = 0.0
        """Wall time of the connection to the manager; 0 without one."""
        self._counts: Counter[type] = Counter()
        """Results by the type of their outcome."""
        self._session: ManagerSession | None = None
        self._renewed_s = time.monotonic()
        self._lease_ttl_s = math.inf
        self._registration: Registration | None = None
        self._conflicts_s: deque[float] = deque(maxlen=CONFLICTS + 1)
        """Times at which another worker of this name took the session over."""
        self._draining = asyncio.Event()
        self._forced = asyncio.Event()

    def _opened_cache(self) -> BundleCache:
        folder = self._settings.cache_dir.expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        return BundleCache(
            folder / "bundles",
            limit_bytes=self._settings.cache_mb * MIB,
            fetch=functools.partial(fetch, lambda: self._session),
        )

    def _new_pool(self, program: tuple[str, ...]) -> SlotPool:
        resources, settings = self._resources, self._settings
        return SlotPool(
            SlotLimits(
                resources.slots, resources.memory_mb, settings.slot_memory_mb, sharing=settings.sharing
            ),
            bundle_path=self._cache.path_of,
            on_result=self._take_result,
            on_change=self._residents_changed,
            log=settings.cache_dir.expanduser() / "simulator.log",
            program=program,
        )

    @property
    def held(self) -> int:
        """Number of leases that wait or run here."""
        return len(self._pool.held())

    def stop(self) -> None:
        """Drain: finish the running leases, then leave. A second call leaves at once."""
        if self._draining.is_set():
            logger.info("leaving at once")
            self._forced.set()
            return
        logger.info("draining held_leases=%d", self.held)
        self._draining.set()
        if self._session is not None:
            self._session.drain()

    async def run(self) -> None:
        """Start the simulator, join the manager and work until stopped."""
        await self._pool.start()
        name, offers = self._membership.name, self._resources
        message = "worker %s: %d slots, %d MB for scenes, score %.2f"
        logger.info(message, name, offers.slots, offers.memory_mb, offers.score)
        activities = (
            self._pool.run(),
            self._stay_connected(),
            self._fence(),
            self._owner_watch.run(),
            MemoryWatch(self._pool).run(),
            StatusFile(self._settings.state_dir, name).update(self._status),
            self._until_left(),
        )
        tasks = [asyncio.create_task(activity) for activity in activities]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        logger.info("left")

    async def _status(self) -> WorkerStatus:
        cache_used_mb = await asyncio.to_thread(self._cache.used_mb)
        running = len(self._pool.progress())
        return WorkerStatus(
            self._membership.name,
            os.getpid(),
            self._started_s,
            manager=self._managers.current,
            connected_since_s=self._connected_since_s,
            paused=self._owner_watch.reason,
            draining=self._draining.is_set(),
            slots=self._resources.slots,
            running=running,
            waiting=self.held - running,
            completed=self._counts[Completed],
            failed=self._counts[InfraFailure],
            unacknowledged=len(self._outbox),
            scenes=len(self._pool.residents()),
            memory_used_mb=round(self._pool.memory_used_mb),
            memory_mb=self._resources.memory_mb,
            cache_used_mb=cache_used_mb,
            cache_mb=self._settings.cache_mb,
        )

    async def _until_left(self) -> None:
        """Return after a drain took too long or was forced."""
        await self._draining.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._settings.drain_s):
                await self._forced.wait()

    async def _stay_connected(self) -> None:
        """Connect and reconnect until the worker has drained."""
        while not (self._draining.is_set() and self._is_done()):
            try:
                if self._registration is None:
                    self._registration = await self._register()
                await self._serve(self._registration)
                if self._session is not None:
                    await self._session.leave()
                return
            except UnknownSessionError as error:
                # Another manager took over. It adopts the held leases once this worker has reported them.
                self._registration = None
                self._backoff.reset()
                await self._wait_before_next(error)
            except SessionLostError as error:
                self._give_up_leases(str(error))
                self._registration = None
                logger.info("registering again: %s", error)
            except SupersededError as error:
                self._give_up_leases(str(error))
                self._note_conflict(error)
            except _PASSING as error:
                if self._settings.once:
                    raise
                self._managers.move(error)
                await self._wait_before_next(error)

    async def _wait_before_next(self, error: ClusterError) -> None:
        """Wait with backoff; a drain ends the wait."""
        wait_s = self._backoff.next_s()
        if self._draining.is_set():
            await asyncio.sleep(min(wait_s, DRAIN_RETRY_S))
            return
        logger.warning("%s (next attempt in %.1f s)", error, wait_s)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                await self._draining.wait()

    def _is_done(self) -> bool:
        return not self._pool.held() and not len(self._outbox)

    async def _register(self) -> Registration:
        registration = await register(
            self._present_membership(), boot_id=self._boot_id, resources=self._resources
        )
        if registration.credential:
            self._join(registration.credential)
        logger.info(
            "registered with the manager at %s session=%s",
            self._managers.current,
            registration.session_id[:SESSION_SHOWN],
        )
        return registration

    def _present_membership(self) -> Membership:
        """Membership with the current one of several managers."""
        return replace(self._membership, manager=self._managers.current)

    def _join(self, credential: str) -> None:
        """Use the credential from now on, in this process and in later ones."""
        hide(credential)
        before = self._membership
        self._membership = replace(before, token=credential, joining=False)
        MembershipFile(self._settings.state_dir, before.token).keep(self._membership)
        logger.info("joined the manager at %s as worker %s", before.manager, before.name)

    async def _serve(self, registration: Registration) -> None:
        bind("session", registration.session_id[:SESSION_SHOWN])
        self._lease_ttl_s = registration.lease_ttl_s
        session = ManagerSession(
            self._present_membership(),
            registration,
            self._pool,
            self._outbox,
            meter=self._meter,
            log_tail=self._log_tail,
            renewed_s=self._renewed(),
        )
        if self._draining.is_set():
            session.drain()
        if self._owner_watch.reason:
            session.pause(self._owner_watch.reason)
        self._session = session
        attached = asyncio.create_task(self._note_attached(session))
        try:
            await session.serve()
        finally:
            attached.cancel()
            self._connected_since_s = 0.0

    async def _note_attached(self, session: ManagerSession) -> None:
        await session.attached.wait()
        self._connected_since_s = time.time()
        self._backoff.reset()

    async def _fence(self) -> None:
        """Drop leases that could not be renewed: the manager has re-dispatched them by then."""
        while True:
            await asyncio.sleep(FENCE_CHECK_S)
            silent_s = time.monotonic() - self._renewed()
            if self._pool.held() and silent_s > self._lease_ttl_s:
                self._give_up_leases(f"no heartbeat was answered for {silent_s:.0f} s")

    def _renewed(self) -> float:
        """Time of the last renewal of the held leases, in any session."""
        if self._session is not None:
            self._renewed_s = max(self._renewed_s, self._session.renewed_s)
        return self._renewed_s

    def _give_up_leases(self, reason: str) -> None:
        held = self._pool.held()
        if held:
            logger.warning("leases given up count=%d: %s", len(held), reason)
        self._pool.cancel(held)

    def _note_conflict(self, error: SupersededError) -> None:
        """Register again, unless another worker of this name keeps doing the same."""
        self._registration = None
        now_s = time.monotonic()
        self._conflicts_s.append(now_s)
        if len(self._conflicts_s) > CONFLICTS and now_s - self._conflicts_s[0] < CONFLICT_WINDOW_S:
            raise SupersededError(
                f"the session of worker {self._membership.name!r} is taken over again and again: another worker of "
                "that name is running; stop it, or give one of them another --name"
            ) from error
        logger.info("registering again: %s", error)

    def _take_result(self, result: LeaseResult) -> None:
        """Queue a result for the manager, with this worker's name."""
        self._counts[type(result.outcome)] += 1
        self._outbox.put(sendable(signed(result, self._membership.name)))
        if self._session is None:
            return
        if result.awaited:
            self._session.notify_awaited()
        else:
            self._session.notify()

    def _pause(self, reason: str) -> None:
        if self._session is not None:
            self._session.pause(reason)

    def _hand_back(self) -> None:
        if self._session is not None:
            self._session.resync()

    def _residents_changed(self) -> None:
        if self._session is not None:
            self._session.notify_state()


def signed(result: LeaseResult, name: str) -> LeaseResult:
    """Return the result with the worker's name."""
    outcome: Completed | InfraFailure
    if isinstance(result.outcome, Completed):
        outcome = result.outcome.noted(worker_id=name)
        logger.debug("rollout completed lease=%s", result.ref.lease_id)
    else:
        outcome = replace(result.outcome, worker_id=name)
        logger.warning("rollout failed lease=%s %s: %s", result.ref.lease_id, outcome.code, outcome.message)
    return replace(result, outcome=outcome)


def sendable(result: LeaseResult) -> LeaseResult:
    """Return the result, or in its place a failure if the manager would refuse it, and with it this worker's stream."""
    outcome = result.outcome
    if isinstance(outcome, InfraFailure):
        return replace(result, outcome=replace(outcome, message=outcome.message[:SENTENCE]))
    if len(outcome.wire) <= RESULT_TEXT // 2:
        return result  # too few bytes to break a bound, which saves a conversion
    try:
        check_result(lease_result_to_proto(result))
    except ConvertError as error:
        text = f"the result can't be sent: {error}"
        failure = InfraFailure(InfraCode.SLOT_CRASHED, text[:SENTENCE], outcome.worker_id)
        logger.warning("result too large lease=%s: %s", result.ref.lease_id, error)
        return replace(result, outcome=failure)
    return result


async def fetch(session_now: Callable[[], ManagerSession | None], digest: str) -> bytes:
    """Fetch a bundle over the current session, and once more, over the next one if it breaks. Raise LoadError."""
    try:
        return await (await _live(session_now)).fetch(digest)
    except (ClusterError, TimeoutError):
        await asyncio.sleep(FETCH_AGAIN_S)
    try:
        return await (await _live(session_now)).fetch(digest)
    except (ClusterError, TimeoutError) as error:
        raise LoadError(InfraCode.SCENE_LOAD_FAILED, f"not fetched: {error}") from error


async def _live(session_now: Callable[[], ManagerSession | None]) -> ManagerSession:
    """Wait for a session that is not over: a manager that starts again takes seconds. Raise LoadError."""
    waited_s = 0.0
    while (session := session_now()) is None or session.is_over:
        if waited_s >= FETCH_S:
            raise LoadError(
                InfraCode.SCENE_LOAD_FAILED, f"there was no connection to the manager for {FETCH_S:g} s"
            )
        await asyncio.sleep(FETCH_AGAIN_S)
        waited_s += FETCH_AGAIN_S
    return session


async def serve(daemon: Daemon, signals: tuple[int, ...]) -> None:
    """Run the daemon. The first of the signals drains it, the second stops it at once."""
    loop = asyncio.get_running_loop()
    for number in signals:
        loop.add_signal_handler(number, daemon.stop)
    try:
        await daemon.run()
    finally:
        for number in signals:
            loop.remove_signal_handler(number)
