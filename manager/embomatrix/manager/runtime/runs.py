"""Open runs and their batches: operations of the trainer."""

import asyncio
import contextlib
import logging
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from embomatrix.host.printable import printable
from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import ManagerCommand
from embomatrix.manager.control.dispatch.batches import group_sizes
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchContinued,
    BatchRestored,
    BatchSubmitted,
    Event,
    LookaheadAnnounced,
    RunOpened,
    WorkersExpected,
)
from embomatrix.manager.observe.run_archive import RUN_ID, RunHistory
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.results import BatchLog, ResultLogs
from embomatrix.manager.runtime.serialization import (
    announced_in,
    batch_of,
    batch_row,
    group_and_kind,
    terms_of,
    terms_payload,
)
from embomatrix.manager.store.protocol import (
    Namespace,
    PutOutcome,
    RunRow,
    StateError,
    StateFullError,
    StateStore,
)
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.status import (
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    OverloadedError,
    PreconditionError,
    UnavailableError,
)
from embomatrix.rpc.wire.values import (
    Batch,
    InfraFailure,
    LookaheadAnswer,
    LookaheadEntry,
    RunStats,
    RunTerms,
)
from embomatrix.skills.syntax import PROFILES
from embomatrix.world.task import Profile

logger = logging.getLogger(__name__)

DEFAULT_TERMS: Final = RunTerms()
BATCH_ROLLOUTS: Final = 65_536
"""Rollouts of one batch at most."""
QUEUED_ROLLOUTS: Final = 262_144
"""Rollouts of all batches together at most."""
RUNS: Final = 1024
QUEUED_SCENES: Final = 8_192
"""Scenes of queued rollouts at most. All are compared whenever scenes are placed."""
LOOKAHEAD_ENTRIES: Final = 4_096
"""Entries of one run's look-ahead window at most."""
ALL_LOOKAHEAD_ENTRIES: Final = 16_384
"""Entries of all windows together at most."""
IDLE_S: Final = 6 * 3600.0
"""A run without pending rollouts is closed after this time without a call."""
PAGE: Final = 4096


class Runs:
    """Open runs and their batches. ``carry_out`` executes commands of the state machines at once."""

    def __init__(
        self,
        cluster: ClusterState,
        store: StateStore,
        bundles: BundleStore,
        logs: ResultLogs,
        carry_out: Callable[[Sequence[ManagerCommand]], None],
        history: RunHistory,
    ) -> None:
        self._cluster = cluster
        self._store = store
        self._bundles = bundles
        self._logs = logs
        self._carry_out = carry_out
        self._history = history
        self._runs: dict[str, RunRow] = {}
        self._heard_s: dict[str, float] = {}
        self._submissions = Submissions(self._feed)
        self._opening_or_closing = asyncio.Lock()
        """Held while a run is opened or closed: a run that is opened anew must not lose its row to the end of the old one."""
        self._still_stored: dict[str, RunStats] = {}
        """Counters of closed runs that the store has not deleted yet."""

    @property
    def open(self) -> Mapping[str, RunRow]:
        """Open runs by id, oldest first."""
        return self._runs

    async def restore(self) -> None:
        """Restore the runs of a former manager. Open batches continue at once, without a call of their trainer."""
        announced = {row.key: announced_in(row) for row in await self._store.rows(Namespace.WINDOWS)}
        for run in await self._store.runs():
            self._runs[run.run_id] = run
            terms = terms_of(run)
            self._feed(RunOpened(run.run_id, terms))
            self._history.opened(run.run_id, run.name, terms.reward)
            self._heard_s[run.run_id] = time.monotonic()
            if run.run_id in announced:
                self._feed(announced[run.run_id])
            for row in await self._store.batches(run.run_id):
                batch = batch_of(row)
                log = BatchLog(run.run_id, row.batch_id, row.digest, groups=group_sizes(batch))
                outcomes = failed = 0
                while page := await self._store.results_after(
                    run.run_id, row.batch_id, log.last_cursor, PAGE
                ):
                    for result in page:
                        group_id, kind, count = group_and_kind(result)
                        log.ends.take(result.cursor, group_id, kind, count)
                        outcomes += count
                        failed += count if kind is InfraFailure else 0
                    log.append(page)
                self._logs.add(log)
                delivered = {result.rollout_id: result.cursor for result in log.rows}
                self._history.submitted(batch)
                self._feed(BatchRestored(batch, delivered, outcomes, failed))
        self._feed(WorkersExpected(await self._store.workers()))
        if self._runs:
            logger.info("restored %d runs of a former manager", len(self._runs))

    async def serve(self) -> None:
        """Queue large batches in slices, until cancelled."""
        await self._submissions.serve()

    async def open_run(self, name: str, run_id: str, terms: RunTerms = DEFAULT_TERMS) -> str:
        """Open a run, or attach to an open one, which keeps its terms. An empty id gets a new one.

        Raises ConflictError for other reward coefficients than those of the open run.
        """
        run_id = run_id or f"run-{secrets.token_hex(6)}"
        if not RUN_ID.fullmatch(run_id):
            raise InvalidRequestError(
                f"run id {run_id[:140]!r}: use up to 128 letters, digits, '.', '_' and '-'"
            )
        if run_id not in self._runs:
            async with self._opening_or_closing:
                await self._open_new(run_id, name, terms)
        if terms.reward not in (PAPER, terms_of(self._runs[run_id]).reward):
            raise ConflictError(
                f"run {run_id!r} was opened with other reward coefficients: keep those, or open another run"
            )
        self._heard_s[run_id] = time.monotonic()
        return run_id

    async def _open_new(self, run_id: str, name: str, terms: RunTerms) -> None:
        if run_id in self._runs:  # another call opened it during the wait for the lock
            return
        if len(self._runs) >= RUNS:
            raise OverloadedError(f"{len(self._runs)} runs are open: close some with CloseRun")
        await self._forget_stored(run_id)
        run = RunRow(run_id, printable(name[:200]), terms_payload(terms))
        with _store_errors():
            await self._store.open_run(run)
        self._runs[run_id] = run
        self._feed(RunOpened(run_id, terms))
        self._history.opened(run_id, run.name, terms.reward)

    def announce(
        self, run_id: str, version: int, entries: tuple[LookaheadEntry, ...]
    ) -> list[LookaheadAnswer]:
        """Replace the run's look-ahead window. Return the loading state of each scene."""
        self.touch(run_id)
        if len(entries) > LOOKAHEAD_ENTRIES:
            raise InvalidRequestError(
                f"{len(entries)} look-ahead entries: at most {LOOKAHEAD_ENTRIES}, announce fewer steps"
            )
        windows = self._cluster.scheduler.windows.items()
        others = sum(len(window.entries) for other, window in windows if other != run_id)
        if others + len(entries) > ALL_LOOKAHEAD_ENTRIES:
            raise OverloadedError(
                f"other runs announced {others} look-ahead entries: at most {ALL_LOOKAHEAD_ENTRIES} fit with these "
                f"{len(entries)}, announce fewer steps"
            )
        self._feed(LookaheadAnnounced(run_id, version, entries))
        scenes = dict.fromkeys(entry.bundle_digest for entry in entries)
        readiness = self._cluster.scheduler.readiness
        return [readiness.answer(scene) for scene in scenes]

    async def submit(self, batch: Batch) -> BatchLog:
        """Queue the batch, or attach to an earlier submission. Return its result log."""
        self.touch(batch.run_id)
        profiles = await self._bundles.profiles(rollout.bundle_digest for rollout in batch.rollouts)
        self.touch(batch.run_id)
        row = batch_row(batch)
        taken = ConflictError(
            f"batch {batch.batch_id!r} was submitted before with other rollouts: use a new id"
        )
        log = self._logs.get(batch.run_id, batch.batch_id)
        if log is not None:
            if log.digest != row.digest:
                raise taken
            return self.log_of(batch.run_id, batch.batch_id)
        if any(rollout.is_turn for rollout in batch.rollouts):
            raise InvalidRequestError(f"batch {batch.batch_id!r} has turns of episodes: send them with Step")
        self._check_batch(batch)
        check_plans(batch, profiles)
        log = BatchLog(batch.run_id, batch.batch_id, row.digest, groups=group_sizes(batch))
        self._logs.add(log)
        try:
            with _store_errors():
                outcome = await self._store.put_batch(row)
            if outcome is PutOutcome.CONFLICT:
                raise taken
            self.touch(batch.run_id)
        except BaseException:
            self._logs.remove(log)
            raise
        self._history.submitted(batch)
        self._submissions.enter(batch)
        return log

    async def check_turns(self, batch: Batch) -> None:
        """Raise the error of ``submit`` if these turns can't be executed."""
        self.touch(batch.run_id)
        profiles = await self._bundles.profiles(rollout.bundle_digest for rollout in batch.rollouts)
        self.touch(batch.run_id)
        self._check_batch(batch)
        check_plans(batch, profiles)

    def enter(self, batch: Batch) -> None:
        """Queue a batch of turns that was checked. Neither the store nor a result log knows it."""
        self._submissions.enter(batch)

    def log_of(self, run_id: str, batch_id: str) -> BatchLog:
        """Return the result log of a submitted batch. Raises NotFoundError."""
        self.touch(run_id)
        log = self._logs.get(run_id, batch_id)
        if log is None:
            raise NotFoundError(
                f"batch {batch_id!r} of run {run_id!r} is unknown or forgotten: submit it again"
            )
        return log

    def cancel(self, run_id: str, batch_id: str) -> None:
        """Cancel a batch: rollouts without an outcome end as cancelled."""
        self.log_of(run_id, batch_id)
        self._feed(BatchCancelled(run_id, batch_id))

    async def close_run(self, run_id: str) -> RunStats:
        """Close the run and discard its results. Return its counters.

        After an UnavailableError of the store the call may be repeated.
        """
        async with self._opening_or_closing:
            if run_id not in self._still_stored:
                self.touch(run_id)
                del self._runs[run_id], self._heard_s[run_id]
                leads = self._history.leads(run_id)
                stats, commands = self._cluster.close_run(run_id, now_s=time.monotonic())
                self._still_stored[run_id] = stats
                self._logs.close_run(run_id)
                self._carry_out(commands)
                await self._history.closed(run_id, stats, leads)
            stats = self._still_stored[run_id]
            await self._forget_stored(run_id)
            return stats

    async def _forget_stored(self, run_id: str) -> None:
        """Delete a closed run from the store, unless that was done."""
        if run_id in self._still_stored:
            with _store_errors():
                await self._store.close_run(run_id)
            del self._still_stored[run_id]

    async def close_idle(self, now_s: float) -> None:
        """Close runs whose trainers disappeared, and delete closed ones that the store could not delete."""
        for run_id in list(self._still_stored):
            with contextlib.suppress(UnavailableError, NotFoundError):
                await self.close_run(run_id)
        for run_id, heard_s in list(self._heard_s.items()):
            if now_s - heard_s > IDLE_S and not self._cluster.dispatcher.pending_of(run_id):
                logger.info("closing idle run run=%s", run_id)
                # A trainer may have closed it during the wait for another one.
                with contextlib.suppress(UnavailableError, NotFoundError):
                    await self.close_run(run_id)

    def touch(self, run_id: str) -> RunRow:
        """Return the open run and note a sign of life of its trainer. Raises NotFoundError."""
        if run_id not in self._runs:
            raise NotFoundError(f"run {run_id!r} is not open: open it with OpenRun")
        self._heard_s[run_id] = time.monotonic()
        return self._runs[run_id]

    def _check_batch(self, batch: Batch) -> None:
        count, name = batch.count, _name(batch)
        if not 0 < count <= BATCH_ROLLOUTS:
            raise InvalidRequestError(f"{name} has {count} rollouts: expected 1 to {BATCH_ROLLOUTS}")
        if len({name for rollout in batch.rollouts for name in (rollout.rollout_id, *rollout.also)}) < count:
            raise InvalidRequestError(f"{name} has a rollout id twice: every id must be unique")
        queued = self._cluster.dispatcher.queued
        if queued + count > QUEUED_ROLLOUTS:
            raise OverloadedError(
                f"{queued} rollouts are queued already: submit again after some have finished"
            )
        scenes = len({rollout.bundle_digest for rollout in batch.rollouts})
        if scenes + self._cluster.dispatcher.waiting_scenes > QUEUED_SCENES:
            raise OverloadedError(
                f"{name} has {scenes} scenes beside {self._cluster.dispatcher.waiting_scenes} that wait: "
                f"at most {QUEUED_SCENES} may; submit fewer at once"
            )
        missing = self._bundles.missing([rollout.bundle_digest for rollout in batch.rollouts])
        if missing:
            raise PreconditionError(
                f"the manager lacks {len(missing)} bundles of {name}, first {missing[0]}: upload them first"
            )

    def _feed(self, event: Event) -> None:
        self._carry_out(self._cluster.handle(event, now_s=time.monotonic()))


def check_plans(batch: Batch, profiles: Mapping[str, Mapping[str, Profile]]) -> None:
    """Raise InvalidRequestError for an unknown task, an empty plan, or a skill outside the task's profile.

    ``profiles`` holds the tasks of the readable bundles by digest and id. Rollouts of other bundles are not checked.
    """
    for rollout in batch.rollouts:
        tasks = profiles.get(rollout.bundle_digest)
        if tasks is None:
            continue
        name = f"{'turn' if rollout.is_turn else 'rollout'} {rollout.rollout_id!r} of {_name(batch)}"
        profile = tasks.get(rollout.task_id)
        if profile is None:
            raise InvalidRequestError(
                f"{name}: bundle {rollout.bundle_digest} has no task {rollout.task_id[:80]!r}: "
                f"expected one of its {len(tasks)} tasks"
            )
        if not rollout.plan and not rollout.only_looks:
            raise InvalidRequestError(f"{name} has an empty plan: expected at least one skill call")
        allowed = PROFILES[profile]
        for call in rollout.plan:
            if call.skill not in allowed:
                raise InvalidRequestError(
                    f"{name}: the profile {profile} of task {rollout.task_id!r} has no skill {call.skill}: "
                    f"expected one of {', '.join(allowed)}"
                )


def _name(batch: Batch) -> str:
    """Return the name of a batch in messages. The id of a batch of turns means nothing to their client."""
    return "this call" if batch.has_turns else f"batch {batch.batch_id!r}"


@contextlib.contextmanager
def _store_errors() -> Iterator[None]:
    """Turn StateError into UnavailableError, and StateFullError into OverloadedError."""
    try:
        yield
    except StateFullError as error:
        raise OverloadedError(str(error)) from error
    except StateError as error:
        raise UnavailableError(str(error)) from error


PIECE: Final = 256
"""Rollouts queued at once, which takes about 3 ms in which nothing else is decided."""


class Submissions:
    """Queues large batches slice by slice. Batches that arrive together take turns. ``feed`` passes an event to the
    state machines.
    """

    def __init__(self, feed: Callable[[Event], None]) -> None:
        self._feed = feed
        self._entering: deque[tuple[str, str, int]] = deque()
        self._more = asyncio.Event()

    def enter(self, batch: Batch) -> None:
        """Queue the first slice at once; ``serve`` queues the rest."""
        self._feed(BatchSubmitted(batch, PIECE))
        left = len(batch.rollouts) - PIECE
        if left > 0:
            self._entering.append((batch.run_id, batch.batch_id, left))
            self._more.set()

    async def serve(self) -> None:
        """Queue the remaining slices, until cancelled."""
        while True:
            await self._more.wait()
            self._more.clear()
            while self._entering:
                # Other events are processed between two slices.
                await asyncio.sleep(0)
                run_id, batch_id, left = self._entering.popleft()
                try:
                    self._feed(BatchContinued(run_id, batch_id, PIECE))
                except Exception:
                    # The rest of the batch ends with its deadline, and the other batches go on.
                    logger.exception("state machine failed on batch=%s of run=%s", batch_id, run_id)
                    continue
                if left > PIECE:
                    self._entering.append((run_id, batch_id, left - PIECE))
