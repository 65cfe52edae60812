"""The worker daemon: keeps a session with the manager through its restarts, and the slots at work meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

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
from embomatrix.rpc.values import Completed, InfraCode
from embomatrix.worker.backoff import Backoff
from embomatrix.worker.cache import BundleCache
from embomatrix.worker.membership import Membership, MembershipFile
from embomatrix.worker.outbox import Outbox
from embomatrix.worker.processes import SIMULATOR_PROGRAM
from embomatrix.worker.residents import LoadError, SlotLimits
from embomatrix.worker.session import Session, register
from embomatrix.worker.slots import SlotPool

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.rpc.values import InfraFailure, LeaseResult, Resources
    from embomatrix.worker.session import Registration
    from embomatrix.worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

LONGEST_WAIT_S: Final = 3.0
"""Between two attempts to connect: a manager that comes back has its workers within five seconds."""
SESSION_SHOWN: Final = 6
"""Letters of a session's id in log lines: whoever knows all of them could speak for this worker."""
FENCE_CHECK_S: Final = 0.5
DRAIN_RETRY_S: Final = 1.0
"""While it drains, a worker tries to deliver its last results at least this often."""
TAKEOVERS_ALLOWED: Final = 3
"""After so many takeovers within a minute, another daemon evidently bears the same name."""
TAKEOVER_WINDOW_S: Final = 60.0
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
    ) -> None:
        self._settings = settings
        self._membership = membership or Membership(settings.manager, settings.name, settings.token)
        self._resources = resources
        self._boot_id = secrets.token_hex(8)
        self._managers = Managers(self._membership.manager)
        # Each of several managers is asked as often as one would be.
        self._backoff = Backoff(rng, longest_s=LONGEST_WAIT_S / self._managers.count)
        self._outbox = Outbox()
        folder = settings.cache_dir.expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        self._cache = BundleCache(
            folder / "bundles", limit_bytes=settings.cache_mb * 1024 * 1024, fetch=self._fetch
        )
        limits = SlotLimits(resources.slots, resources.memory_mb, settings.slot_memory_mb)
        self._pool = SlotPool(
            limits,
            bundle_path=self._cache.path_of,
            on_result=self._take_result,
            on_change=self._residents_changed,
            log=folder / "simulator.log",
            program=program,
        )
        self._session: Session | None = None
        self._renewed_s = time.monotonic()
        self._lease_ttl_s = math.inf
        self._registration: Registration | None = None
        self._takeovers: list[float] = []
        self._draining = asyncio.Event()
        self._forced = asyncio.Event()

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
        if self._session is not None:
            self._session.drain()

    async def run(self) -> None:
        """Start the simulator, join the manager and work until stopped."""
        await self._pool.start()
        logger.info(
            "worker %s: %d slots, %d MB for scenes, score %.2f",
            self._membership.name,
            self._resources.slots,
            self._resources.memory_mb,
            self._resources.score,
        )
        tasks = [
            asyncio.create_task(work)
            for work in (self._pool.run(), self._stay_connected(), self._fence(), self._until_left())
        ]
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
                await self._say_goodbye()
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

    async def _say_goodbye(self) -> None:
        if self._session is not None:
            await self._session.leave()

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
        session = Session(
            self._present_membership(),
            registration,
            self._pool,
            self._outbox,
            renewed_s=self._renewed(),
        )
        if self._draining.is_set():
            session.drain()
        self._session = session
        attached = asyncio.create_task(self._note_attached(session))
        try:
            await session.serve()
        finally:
            attached.cancel()

    async def _note_attached(self, session: Session) -> None:
        await session.attached.wait()
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
        self._pool.cancel_all()

    def _count_takeover(self, error: SupersededError) -> None:
        """Register again, unless another daemon of this name would do the same, for ever."""
        self._registration = None
        now_s = time.monotonic()
        self._takeovers = [at_s for at_s in self._takeovers if now_s - at_s < TAKEOVER_WINDOW_S] + [now_s]
        if len(self._takeovers) > TAKEOVERS_ALLOWED:
            raise SupersededError(
                f"the session of worker {self._membership.name!r} is taken over again and again: another worker of "
                "that name is running; stop it, or give one of them another --name"
            ) from error
        logger.info("registering again: %s", error)

    async def _fetch(self, digest: str) -> bytes:
        """Fetch a bundle over the present session; a broken connection is tried once more on the next."""
        for last in (False, True):
            session = self._session
            if session is None:
                break
            try:
                return await session.fetch(digest)
            except (ClusterError, TimeoutError) as error:
                if last:
                    raise LoadError(InfraCode.SCENE_LOAD_FAILED, f"not fetched: {error}") from error
                await asyncio.sleep(self._backoff.first_s * 5)
        raise LoadError(InfraCode.SCENE_LOAD_FAILED, "there is no connection to the manager")

    def _take_result(self, result: LeaseResult) -> None:
        """Keep a result for the manager, signed with this worker's name."""
        outcome: Completed | InfraFailure
        if isinstance(result.outcome, Completed):
            outcome = result.outcome.noted(worker_id=self._membership.name)
            logger.debug("rollout completed lease=%s reward=%.1f", result.ref.lease_id, outcome.reward.total)
        else:
            outcome = replace(result.outcome, worker_id=self._membership.name)
            logger.warning(
                "rollout failed lease=%s %s: %s", result.ref.lease_id, outcome.code, outcome.message
            )
        self._outbox.put(replace(result, outcome=outcome))
        if self._session is not None:
            self._session.tell()

    def _residents_changed(self) -> None:
        if self._session is not None:
            self._session.tell_state()


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
