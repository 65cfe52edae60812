"""From plan texts to rewards: a gateway that keeps the cluster busy while the trainer computes.

The client runs on an event loop in its own thread. A group is submitted as soon as its plans are sampled, and waited for
only when its rewards are needed.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, Self, TypeVar

from embomatrix.reward.hierarchy import unparsable
from embomatrix.rpc.logs import bind
from embomatrix.rpc.status import ClusterError, DeadlineError, PreconditionError, UnavailableError
from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Rollout, RunStats, RunTerms
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, with_indices
from embomatrix.trainer.run.data import group_seed
from embomatrix.trainer.run.errors import TrainerError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping, Sequence
    from concurrent.futures import Future
    from contextlib import AbstractAsyncContextManager
    from typing import Any

    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.reward.settings import RewardSettings
    from embomatrix.rpc.wire.training import TrainingReport
    from embomatrix.rpc.wire.values import Outcome, RolloutResult, Warmth
    from embomatrix.skills.prompt import Situation
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.run.data import TrainingTask

logger = logging.getLogger(__name__)
T = TypeVar("T")
DEFAULT_TERMS: Final = RunTerms()
REPORTS_KEPT: Final = 64
"""That wait for a manager which is away: those of the last steps."""
AWAY_S: Final = 600.0
"""For which a scene waits for a manager that is away: as long as a batch waits for its results."""
AWAY_FIRST_S: Final = 0.1
AWAY_LONGEST_S: Final = 5.0
"""Wait before a scene is sent again: doubled from the first to the longest."""


class Cluster(Protocol):
    """What the gateway needs of ``rpc.client.ClusterClient``."""

    async def open_run(self, name: str, run_id: str = "", terms: RunTerms = DEFAULT_TERMS) -> str: ...

    async def announce_lookahead(
        self, run_id: str, version: int, entries: Iterable[LookaheadEntry]
    ) -> dict[str, Warmth]: ...

    async def put_bundles(self, bundles: Mapping[str, bytes]) -> tuple[str, ...]: ...

    def execute(self, batch: Batch) -> AsyncIterator[RolloutResult]: ...

    async def report_training(self, run_id: str, report: TrainingReport) -> None: ...

    async def close_run(self, run_id: str) -> RunStats: ...


@dataclass(frozen=True, slots=True)
class PlanOutcome:
    """One sampled plan and what became of it.

    ``reward`` is None where the infrastructure lost the rollout: that says nothing about the plan. ``outcome`` is None for
    text that is no plan, which is scored here and never executed; ``problem`` then says why.
    """

    text: str
    reward: RewardBreakdown | None
    outcome: Outcome | None = None
    problem: str = ""

    @property
    def value(self) -> float:
        """The reward's total; NaN where there is none."""
        return math.nan if self.reward is None else self.reward.total

    def valued(self, relevance: float) -> float:
        """The reward with its second tier weighted; NaN where there is none."""
        reward = self.reward
        return math.nan if reward is None else reward.format + relevance * reward.relevance + reward.goal

    @property
    def success(self) -> bool:
        return self.reward is not None and self.reward.success


class Submitting(Protocol):
    """What a step of GRPO needs of a gateway."""

    def submit(
        self,
        batch_id: str,
        step: int,
        task: TrainingTask,
        situation: Situation,
        texts: Sequence[str],
        codec: Codec,
    ) -> Future[tuple[PlanOutcome, ...]]:
        """Have the plans of one task executed; outcomes come in the order of ``texts``."""
        ...


def parsed(text: str, situation: Situation, codec: Codec) -> Plan:
    """The plan that a policy's text means. Raises PlanError when it means none."""
    return parse_plan(with_indices(text, situation) if codec is Codec.NAMES else text, situation.profile)


class Gateway:
    """Context manager over one run of the cluster. Methods are called from the trainer's thread, ``submit`` from any.

    ``terms`` say what becomes of the rest of a group that lost a rollout, for nobody executes what is left out anyway, and
    how plans are scored: by the worker, and here where a text is none.
    """

    def __init__(
        self,
        open_cluster: Callable[[], AbstractAsyncContextManager[Cluster]],
        bundle_bytes: Callable[[str], bytes],
        *,
        run_name: str,
        run_seed: int,
        terms: RunTerms = DEFAULT_TERMS,
    ) -> None:
        self._open_cluster = open_cluster
        self._bundle_bytes = bundle_bytes
        self._run_name = run_name
        self._run_seed = run_seed
        self._terms = terms
        self._announced = 0
        self._sent: dict[str, asyncio.Task[None]] = {}
        self._reports: deque[TrainingReport] = deque(maxlen=REPORTS_KEPT)
        self._reporting = asyncio.Lock()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway", daemon=True)
        self._stats: RunStats | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._wait(self._open())
        except BaseException:
            self._stop_thread()
            raise
        bind("run", self.run_id)
        return self

    async def _open(self) -> None:
        self._context = self._open_cluster()
        self._cluster = await self._context.__aenter__()
        try:
            self.run_id = await self._cluster.open_run(self._run_name, terms=self._terms)
        except BaseException:
            await self._context.__aexit__(None, None, None)
            raise

    def __exit__(self, *_: object) -> None:
        try:
            self.close_run()
        except TrainerError as error:
            logger.warning("the run could not be closed: %s", error)
        finally:
            self._wait(self._leave())
            self._stop_thread()

    def close_run(self) -> RunStats:
        """End the run at the manager, once, whatever is still under way; returns its counters."""
        if self._stats is None:
            self._stats = self._wait(self._close())
        return self._stats

    async def _leave(self) -> None:
        await self._context.__aexit__(None, None, None)

    async def _close(self) -> RunStats:
        own = asyncio.current_task()
        pending = [task for task in asyncio.all_tasks() if task is not own]
        for task in pending:
            task.cancel()
        await asyncio.gather(*pending, return_exceptions=True)
        await self._send_reports()
        return await self._cluster.close_run(self.run_id)

    def _stop_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        return waited(asyncio.run_coroutine_threadsafe(work, self._loop))

    def announce(self, steps: Mapping[int, Sequence[TrainingTask]], group: int) -> None:
        """Replace the look-ahead: which tasks coming steps need. Advice only, so a refusal is logged."""
        entries = [
            LookaheadEntry(step, task.bundle_digest, group) for step, tasks in steps.items() for task in tasks
        ]
        self._announced += 1
        asyncio.run_coroutine_threadsafe(self._announce(self._announced, entries), self._loop)

    async def _announce(self, version: int, entries: list[LookaheadEntry]) -> None:
        try:
            for entry in entries:
                if version != self._announced:
                    return  # a newer window has overtaken this one
                await self._bundle_sent(entry.bundle_digest)
            if version == self._announced:
                await self._cluster.announce_lookahead(self.run_id, version, entries)
        except ClusterError as error:
            logger.warning("the look-ahead was not taken: %s", error)

    async def _bundle_sent(self, digest: str) -> None:
        """Give the manager a bundle once in a run; a failed attempt may be repeated by the next caller."""
        task = self._sent.get(digest)
        if task is None or (task.done() and (task.cancelled() or task.exception() is not None)):
            task = self._sent[digest] = asyncio.create_task(self._send_bundle(digest))
        await asyncio.shield(task)

    async def _send_bundle(self, digest: str) -> None:
        bundle = {digest: self._bundle_bytes(digest)}
        until_s, wait_s = self._loop.time() + AWAY_S, AWAY_FIRST_S
        while True:
            try:
                await self._cluster.put_bundles(bundle)
            except (UnavailableError, DeadlineError) as error:
                if self._loop.time() + wait_s > until_s:
                    raise
                logger.warning("scene %s: sending it again after: %s", digest, error)
            else:
                return
            await asyncio.sleep(wait_s)
            wait_s = min(2 * wait_s, AWAY_LONGEST_S)

    def report(self, report: TrainingReport) -> None:
        """Tell people who watch how training goes. Waits for nobody: what can't be told is dropped, and logged."""
        self._reports.append(report)
        asyncio.run_coroutine_threadsafe(self._send_reports(), self._loop)

    async def _send_reports(self) -> None:
        async with self._reporting:
            while self._reports:
                report = self._reports[0]
                try:
                    await self._cluster.report_training(self.run_id, report)
                except (UnavailableError, DeadlineError):
                    return  # the next report tries again, with those that wait
                except PreconditionError as error:
                    logger.warning("the dashboard does not show this training: %s", error)
                    self._reports = deque(maxlen=0)
                except ClusterError as error:
                    logger.warning("a report of training was not taken: %s", error)
                # A newer one may have pushed it out meanwhile.
                if self._reports and self._reports[0] is report:
                    self._reports.popleft()

    def submit(
        self,
        batch_id: str,
        step: int,
        task: TrainingTask,
        situation: Situation,
        texts: Sequence[str],
        codec: Codec,
    ) -> Future[tuple[PlanOutcome, ...]]:
        """Start the rollouts of one task's plans; outcomes come in the order of ``texts``.

        ``situation`` is the telling that the texts answer: it knows what their names mean.
        """
        plans: list[Plan | PlanOutcome] = [
            _plan_or_verdict(text, situation, codec, self._terms.reward) for text in texts
        ]
        rollouts = tuple(
            Rollout(
                rollout_id=f"{self.run_id}/{batch_id}/{index}",
                group_id=f"{self.run_id}/{batch_id}",
                bundle_digest=task.bundle_digest,
                task_id=task.task.task_id,
                plan=plan,
                seed=group_seed(self._run_seed, task.task.task_id),
            )
            for index, plan in enumerate(plans)
            if not isinstance(plan, PlanOutcome)
        )
        batch = Batch(self.run_id, batch_id, step, rollouts)
        work = self._execute(batch, texts, plans)
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    async def _execute(
        self, batch: Batch, texts: Sequence[str], plans: Sequence[Plan | PlanOutcome]
    ) -> tuple[PlanOutcome, ...]:
        outcomes: dict[str, Outcome] = {}
        if batch.rollouts:
            await self._bundle_sent(batch.rollouts[0].bundle_digest)
            async for result in self._cluster.execute(batch):
                outcomes[result.rollout_id] = result.outcome
        return tuple(
            plan
            if isinstance(plan, PlanOutcome)
            else _plan_outcome(text, outcomes.get(f"{self.run_id}/{batch.batch_id}/{index}"))
            for index, (text, plan) in enumerate(zip(texts, plans, strict=True))
        )


def _plan_or_verdict(
    text: str, situation: Situation, codec: Codec, reward: RewardSettings
) -> Plan | PlanOutcome:
    try:
        return parsed(text, situation, codec)
    except PlanError as error:
        return PlanOutcome(text, unparsable(reward), problem=str(error))


def _plan_outcome(text: str, outcome: Outcome | None) -> PlanOutcome:
    if isinstance(outcome, Completed):
        return PlanOutcome(text, outcome.reward, outcome)
    return PlanOutcome(text, None, outcome)


def waited(future: Future[T]) -> T:
    """The future's value; what went wrong with the cluster becomes a TrainerError."""
    try:
        return future.result()
    except ClusterError as error:
        raise TrainerError(str(error)) from error
