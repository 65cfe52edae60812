"""The worker daemon: keeps a session with the manager through its restarts, and the slots at work meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import secrets
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.host.backoff import Backoff
from embomatrix.host.cgroup import MIB
from embomatrix.rpc.logs import bind, hide
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import (
    ClusterError,
    DeadlineError,
    InternalError,
    OverloadedError,
    SupersededError,
    UnavailableError,
    UnknownSessionError,
)
from embomatrix.rpc.wire.values import Completed, InfraCode
from embomatrix.worker.host.courtesy import Courtesy
from embomatrix.worker.host.machine import HostMachine
from embomatrix.worker.host.spare_memory import SpareMemory
from embomatrix.worker.host.status import StatusReport, daemon_pids
from embomatrix.worker.link.cache import BundleCache
from embomatrix.worker.link.membership import Membership, MembershipFile
from embomatrix.worker.link.outbox import ResultOutbox
from embomatrix.worker.link.session import ManagerSession, register
from embomatrix.worker.link.takeovers import Takeovers
from embomatrix.worker.slots.pool import SlotPool
from embomatrix.worker.slots.processes import SIMULATOR_PROGRAM
from embomatrix.worker.slots.residents import LoadError, SlotLimits

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from embomatrix.rpc.wire.leases import LeaseResult
    from embomatrix.rpc.wire.values import InfraFailure, Resources
    from embomatrix.worker.host.machine import Probe
    from embomatrix.worker.host.settings import WorkerSettings
    from embomatrix.worker.link.session import Registration

logger = logging.getLogger(__name__)

FIRST_WAIT_S: Final = 0.2
LONGEST_WAIT_S: Final = 3.0
"""Between two attempts to connect: a manager that comes back has its workers within five seconds."""
SESSION_SHOWN: Final = 6
"""Letters of a session's id in log lines: whoever knows all of them could speak for this worker."""
FENCE_CHECK_S: Final = 0.5
FETCH_AGAIN_S: Final = 0.25
"""Before a bundle is asked for a second time: the connection broke, and a next one may be there by then."""
DRAIN_RETRY_S: Final = 1.0
"""While it drains, a worker tries to deliver its last results at least this often."""
_PASSING: Final = (UnavailableError, DeadlineError, OverloadedError, InternalError)
"""Errors after which the daemon connects again. Others need a person."""


class Daemon:
    """One worker. ``run`` returns when it has left; it raises ClusterError for what trying again can't mend."""

    def __init__(
        self,
        settings: WorkerSettings,
        resources: Resources,
        rng: np.random.Generator,
        *,
        program: tuple[str, ...] = SIMULATOR_PROGRAM,
        membership: Membership | None = None,
        probe: Probe | None = None,
    ) -> None:
        self._settings = settings
        self._membership = membership or Membership(settings.manager, settings.name, settings.token)
        self._resources = resources
        self._boot_id = secrets.token_hex(8)
        self._managers = Managers(self._membership.manager)
        # Each of several managers is asked as often as one would be.
        self._backoff = Backoff(
            FIRST_WAIT_S, LONGEST_WAIT_S / self._managers.count, jitter=lambda: float(rng.uniform(0.8, 1.2))
        )
        self._outbox = ResultOutbox()
        self._cache = self._opened_cache()
        self._pool = self._new_pool(program)
        self._courtesy = Courtesy(
            settings.preferences,
            probe or HostMachine(lambda: daemon_pids(settings.state_dir)),
            self._pool,
            on_pause=self._pause,
            on_hand_back=self._hand_back,
        )
        self._report = StatusReport(
            self._membership, settings, resources, self._pool, self._cache, self._outbox
        )
        self._session: ManagerSession | None = None
        self._renewed_s = time.monotonic()
        self._lease_ttl_s = math.inf
        self._registration: Registration | None = None
        self._takeovers = Takeovers()
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
            SlotLimits(resources.slots, resources.memory_mb, settings.slot_memory_mb),
            bundle_path=self._cache.path_of,
            on_result=self._take_result,
            on_change=self._residents_changed,
            log=settings.cache_dir.expanduser() / "simulator.log",
            program=program,
        )

    @property
    def held(self) -> int:
        """Leases that wait or run here."""
        return len(self._pool.held())

    def stop(self) -> None:
        """Drain: finish what runs, then leave. Called again, leave at once."""
        if self._draining.is_set():
            logger.info("leaving at once")
            self._forced.set()
            return
        logger.info("draining: %d leases are held", self.held)
        self._draining.set()
        self._report.draining()
        if self._session is not None:
            self._session.drain()

    async def run(self) -> None:
        """Start the simulator, join the manager and work until stopped."""
        await self._pool.start()
        name, offers = self._membership.name, self._resources
        told = "worker %s: %d slots, %d MB for scenes, score %.2f"
        logger.info(told, name, offers.slots, offers.memory_mb, offers.score)
        works = (
            self._pool.run(),
            self._stay_connected(),
            self._fence(),
            self._courtesy.run(),
            SpareMemory(self._pool).run(),
            self._report.run(),
            self._until_left(),
        )
        tasks = [asyncio.create_task(work) for work in works]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        logger.info("left")

    async def _until_left(self) -> None:
        """Ends when a drain took too long, or when it was forced."""
        await self._draining.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._settings.drain_s):
                await self._forced.wait()

    async def _stay_connected(self) -> None:
        """Connect, and connect again, until the worker has drained."""
        while not (self._draining.is_set() and self._owes_nothing()):
            try:
                if self._registration is None:
                    self._registration = await self._register()
                await self._serve(self._registration)
                if self._session is not None:
                    await self._session.leave()
                return
            except UnknownSessionError as error:
                # A manager took over. It takes up what is held here once this worker has said what that is.
                self._registration = None
                self._backoff.reset()
                await self._wait_before_next(error)
            except SupersededError as error:
                self._give_up_leases(str(error))
                self._count_takeover(error)
            except _PASSING as error:
                if self._settings.once:
                    raise
                self._managers.move(error)
                await self._wait_before_next(error)

    async def _wait_before_next(self, error: ClusterError) -> None:
        """Wait, longer each time; a drain ends the wait."""
        wait_s = self._backoff.next_s()
        if self._draining.is_set():
            await asyncio.sleep(min(wait_s, DRAIN_RETRY_S))
            return
        logger.warning("%s (next attempt in %.1f s)", error, wait_s)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                await self._draining.wait()

    def _owes_nothing(self) -> bool:
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
        """The membership with the manager that this worker turns to at present, where there are several."""
        return replace(self._membership, manager=self._managers.current)

    def _join(self, credential: str) -> None:
        """From here on this worker shows the credential, in this process and in those after it."""
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
            renewed_s=self._renewed(),
        )
        if self._draining.is_set():
            session.drain()
        if self._courtesy.reason:
            session.pause(self._courtesy.reason)
        self._session = session
        attached = asyncio.create_task(self._note_attached(session))
        try:
            await session.serve()
        finally:
            attached.cancel()
            self._report.disconnected()

    async def _note_attached(self, session: ManagerSession) -> None:
        await session.attached.wait()
        self._report.connected(self._managers.current)
        self._backoff.reset()

    async def _fence(self) -> None:
        """Stop executing what can't be renewed: the manager has given it to others by then."""
        while True:
            await asyncio.sleep(FENCE_CHECK_S)
            silent_s = time.monotonic() - self._renewed()
            if self._pool.held() and silent_s > self._lease_ttl_s:
                self._give_up_leases(f"no heartbeat was answered for {silent_s:.0f} s")

    def _renewed(self) -> float:
        """When a manager last renewed what is held here, in whichever session."""
        if self._session is not None:
            self._renewed_s = max(self._renewed_s, self._session.renewed_s)
        return self._renewed_s

    def _give_up_leases(self, reason: str) -> None:
        held = self._pool.held()
        if held:
            logger.warning("%d leases given up: %s", len(held), reason)
        self._pool.cancel(held)

    def _count_takeover(self, error: SupersededError) -> None:
        """Register again, unless another daemon of this name would do the same, for ever."""
        self._registration = None
        if self._takeovers.add(time.monotonic()):
            raise SupersededError(
                f"the session of worker {self._membership.name!r} is taken over again and again: another worker of "
                "that name is running; stop it, or give one of them another --name"
            ) from error
        logger.info("registering again: %s", error)

    def _take_result(self, result: LeaseResult) -> None:
        """Keep a result for the manager, signed with this worker's name."""
        self._report.finished(result)
        self._outbox.put(signed(result, self._membership.name))
        if self._session is not None:
            self._session.tell()

    def _pause(self, reason: str) -> None:
        self._report.paused(reason)
        if self._session is not None:
            self._session.pause(reason)

    def _hand_back(self) -> None:
        if self._session is not None:
            self._session.resync()

    def _residents_changed(self) -> None:
        if self._session is not None:
            self._session.tell_state()


def signed(result: LeaseResult, name: str) -> LeaseResult:
    """The result with the name of the worker that it is from."""
    outcome: Completed | InfraFailure
    if isinstance(result.outcome, Completed):
        outcome = result.outcome.noted(worker_id=name)
        logger.debug("rollout completed lease=%s", result.ref.lease_id)
    else:
        outcome = replace(result.outcome, worker_id=name)
        logger.warning("rollout failed lease=%s %s: %s", result.ref.lease_id, outcome.code, outcome.message)
    return replace(result, outcome=outcome)


async def fetch(session_now: Callable[[], ManagerSession | None], digest: str) -> bytes:
    """Fetch a bundle over the present session; a broken connection is tried once more on the next. Raises LoadError."""
    for last in (False, True):
        session = session_now()
        if session is None:
            break
        try:
            return await session.fetch(digest)
        except (ClusterError, TimeoutError) as error:
            if last:
                raise LoadError(InfraCode.SCENE_LOAD_FAILED, f"not fetched: {error}") from error
            await asyncio.sleep(FETCH_AGAIN_S)
    raise LoadError(InfraCode.SCENE_LOAD_FAILED, "there is no connection to the manager")


async def serve(daemon: Daemon, signals: tuple[int, ...]) -> None:
    """Run the daemon; each of the signals stops it, the second time at once."""
    loop = asyncio.get_running_loop()
    for number in signals:
        loop.add_signal_handler(number, daemon.stop)
    try:
        await daemon.run()
    finally:
        for number in signals:
            loop.remove_signal_handler(number)
