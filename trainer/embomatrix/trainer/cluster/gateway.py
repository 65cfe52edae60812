"""Gateway of a trainer to the cluster: plan texts in, rewards out, while the trainer computes.

The gRPC client runs on an event loop in its own thread. A group is submitted as soon as its plans are sampled, and the
trainer waits only when it needs the rewards.
"""

import asyncio
import contextlib
import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self, TypeVar

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import unparsable
from embomatrix.reward.settings import RewardSettings
from embomatrix.reward.turns import RunningEpisode
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.episodes import Episodes
from embomatrix.rpc.logs import bind
from embomatrix.rpc.status import ClusterError, DeadlineError, PreconditionError, UnavailableError
from embomatrix.rpc.wire.training import TrainingReport
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Outcome,
    Rollout,
    RolloutResult,
    RunStats,
    RunTerms,
)
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, Situation, with_indices
from embomatrix.skills.syntax import Plan
from embomatrix.skills.trace import Step
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TrainingTask

logger = logging.getLogger(__name__)
T = TypeVar("T")
DEFAULT_TERMS: Final = RunTerms()
MAX_QUEUED_REPORTS: Final = 64
"""Reports kept while the manager is unreachable. Older ones are dropped."""
RETRY_BUNDLE_S: Final = 600.0
"""Seconds to retry a bundle upload while the manager is unreachable: equal to the batch timeout."""
FIRST_RETRY_S: Final = 0.1
MAX_RETRY_S: Final = 5.0
"""The wait between two attempts doubles from ``FIRST_RETRY_S`` up to this value."""


@dataclass(frozen=True, slots=True)
class PlayedTurn:
    """Answer of an episode, and the observation that followed it. ``steps`` counts the answer's calls."""

    answer: str
    observation: str
    steps: int


@dataclass(frozen=True, slots=True)
class Transcript:
    """Texts of an episode: those before the first answer, then turn by turn. ``end`` says why it ended."""

    opening: str
    turns: tuple[PlayedTurn, ...]
    end: str


@dataclass(frozen=True, slots=True)
class PlanOutcome:
    """One sampled plan and its result.

    ``reward`` is None if the infrastructure lost the rollout, which says nothing about the plan. ``outcome`` is None for text
    that can't be parsed: it is scored here and never executed, and ``problem`` gives the reason.

    The text of an episode has its answers, and ``outcome`` is only that of a lost one: ``played`` has its steps, failed ones
    included, ``cost`` what they cost, and ``transcript`` all its texts.
    """

    text: str
    reward: RewardBreakdown | None
    outcome: Outcome | None = None
    problem: str = ""
    cost: float = 0.0
    played: tuple[Step, ...] = ()
    transcript: Transcript | None = None

    @property
    def value(self) -> float:
        """Total reward, NaN if there is none."""
        return math.nan if self.reward is None else self.reward.total - self.cost

    @property
    def steps(self) -> tuple[Step, ...]:
        """Executed steps; none for a lost or unparsable plan."""
        return self.outcome.steps if isinstance(self.outcome, Completed) else self.played

    @property
    def lost(self) -> str:
        """Reason why the infrastructure lost the rollout, else ""."""
        match self.outcome:
            case InfraFailure(code=code, message=message):
                return f"{code.value}: {message}"
            case Cancelled():
                return "cancelled"
        return ""

    def weighted_reward(self, relevance: float) -> float:
        """Reward with a weight on its relevance tier, NaN if there is none."""
        reward = self.reward
        if reward is None:
            return math.nan
        return reward.format + relevance * reward.relevance + reward.goal - self.cost

    @property
    def success(self) -> bool:
        return self.reward is not None and self.reward.success


@dataclass(frozen=True, slots=True)
class PlanGroup:
    """Plans of one task, to be executed with one seed.

    ``situation`` is the varied situation of the prompt, which resolves the object names in the texts.
    """

    task: TrainingTask
    situation: Situation
    texts: Sequence[str]
    seed: int


class PlanSubmitter(Protocol):
    """Part of the gateway that a GRPO step uses."""

    def submit(
        self, batch_id: str, step: int, groups: Sequence[PlanGroup], codec: Codec
    ) -> list[Future[tuple[PlanOutcome, ...]]]:
        """Execute the plans of these groups. Return a future for each group; its outcomes keep the order of the texts."""
        ...


def parse_policy_text(text: str, situation: Situation, codec: Codec) -> Plan:
    """Parse a policy's text. Raises PlanError if it holds no plan."""
    return parse_plan(with_indices(text, situation) if codec is Codec.NAMES else text, situation.profile)


class _PendingGroup:
    """Group whose outcomes are awaited."""

    def __init__(self, group_id: str, group: PlanGroup, plans: Sequence[Plan | PlanOutcome]) -> None:
        """``plans`` holds the outcome of each text that can't be parsed."""
        self.group_id = group_id
        self.future: Future[tuple[PlanOutcome, ...]] = Future()
        self._group = group
        self._plans = plans
        self._outcomes: list[PlanOutcome | None] = [
            plan if isinstance(plan, PlanOutcome) else None for plan in plans
        ]

    def rollouts(self) -> Iterator[Rollout]:
        """Yield the rollouts of the texts that are plans."""
        task = self._group.task
        for index, plan in enumerate(self._plans):
            if not isinstance(plan, PlanOutcome):
                yield Rollout(
                    rollout_id=f"{self.group_id}/{index}",
                    group_id=self.group_id,
                    bundle_digest=task.bundle_digest,
                    task_id=task.task.task_id,
                    plan=plan,
                    seed=self._group.seed,
                )

    def take(self, result: RolloutResult) -> None:
        index = int(result.rollout_id.rpartition("/")[2])
        self._outcomes[index] = _plan_outcome(self._group.texts[index], result.outcome)
        self.settle_if_complete()

    def settle_if_complete(self) -> None:
        """Hand over the outcomes once there are all."""
        outcomes = tuple(one for one in self._outcomes if one is not None)
        if len(outcomes) == len(self._outcomes) and not self.future.done():
            self.future.set_result(outcomes)

    def fail(self, error: BaseException) -> None:
        """Hand over an error, unless the outcomes are there."""
        if self.future.done():
            return
        if isinstance(error, asyncio.CancelledError):
            self.future.cancel()
        else:
            self.future.set_exception(error)


class Gateway:
    """Context manager over one run of the cluster. Call ``submit`` and ``run`` from any thread, and all other methods
    from the trainer's.

    ``terms`` set the policy for groups that lost a rollout, and the reward's coefficients. ``on_submit`` gets every batch that
    has rollouts, on the gateway's thread.
    """

    def __init__(
        self,
        open_cluster: Callable[[], AbstractAsyncContextManager[ClusterClient]],
        bundle_bytes: Callable[[str], bytes],
        *,
        run_name: str,
        terms: RunTerms = DEFAULT_TERMS,
        on_submit: Callable[[Batch], None] = lambda _: None,
    ) -> None:
        self._open_cluster = open_cluster
        self._bundle_bytes = bundle_bytes
        self._run_name = run_name
        self._terms = terms
        self._on_submit = on_submit
        self._announced = 0
        self._uploads: dict[str, asyncio.Task[None]] = {}
        self._reports: deque[TrainingReport] = deque(maxlen=MAX_QUEUED_REPORTS)
        self._reporting = asyncio.Lock()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway", daemon=True)
        self._stats: RunStats | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._run_on_loop(self._open())
        except BaseException:
            self._stop_thread()
            raise
        bind("run", self.run_id)
        return self

    async def _open(self) -> None:
        async with contextlib.AsyncExitStack() as stack:
            self._cluster = await stack.enter_async_context(self._open_cluster())
            self.run_id = await self._cluster.open_run(self._run_name, terms=self._terms)
            self._episodes = await stack.enter_async_context(Episodes(self._cluster, self.run_id))
            self._connection = stack.pop_all()

    def __exit__(self, *_: object) -> None:
        try:
            self.close_run()
        except TrainerError as error:
            logger.warning("run not closed at the manager: %s", error)
        finally:
            self._run_on_loop(self._connection.aclose())
            self._stop_thread()

    def close_run(self) -> RunStats:
        """Cancel pending work, end the run at the manager, and return its counters. Later calls return the same counters."""
        if self._stats is None:
            self._stats = self._run_on_loop(self._close())
        return self._stats

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

    def _run_on_loop(self, work: Coroutine[Any, Any, T]) -> T:
        return result_of(self.run(work))

    def run(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        """Start work on the gateway's thread, such as turns of episodes."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    @property
    def reward(self) -> RewardSettings:
        """Coefficients of the run's reward."""
        return self._terms.reward

    async def begin_episode(self, task: TrainingTask, seed: int, *, sight: bool) -> RunningEpisode:
        """Begin an episode, on the gateway's thread. Raises ClusterError if the task's bundle can't be uploaded."""
        await self._upload_once(task.bundle_digest)
        return self._episodes.begin(task.bundle_digest, task.task.task_id, seed, sight=sight)

    def announce(self, steps: Mapping[int, Sequence[TrainingTask]], group: int) -> None:
        """Replace the look-ahead: the tasks of the coming steps. A rejection is only logged, because look-ahead is advice."""
        entries = [
            LookaheadEntry(step, task.bundle_digest, group) for step, tasks in steps.items() for task in tasks
        ]
        self._announced += 1
        asyncio.run_coroutine_threadsafe(self._announce(self._announced, entries), self._loop)

    async def _announce(self, version: int, entries: list[LookaheadEntry]) -> None:
        try:
            for entry in entries:
                if version != self._announced:
                    return  # superseded by a newer window
                await self._upload_once(entry.bundle_digest)
            if version == self._announced:
                await self._cluster.announce_lookahead(self.run_id, version, entries)
        except ClusterError as error:
            logger.warning("look-ahead rejected: %s", error)

    async def _upload_once(self, digest: str) -> None:
        """Upload a bundle once per run. After a failure, the next caller retries."""
        task = self._uploads.get(digest)
        if task is None or (task.done() and (task.cancelled() or task.exception() is not None)):
            task = self._uploads[digest] = asyncio.create_task(self._upload(digest))
        await asyncio.shield(task)

    async def _upload(self, digest: str) -> None:
        bundle = {digest: self._bundle_bytes(digest)}
        deadline_s, wait_s = self._loop.time() + RETRY_BUNDLE_S, FIRST_RETRY_S
        while True:
            try:
                await self._cluster.put_bundles(bundle)
            except (UnavailableError, DeadlineError) as error:
                if self._loop.time() + wait_s > deadline_s:
                    raise
                logger.warning("bundle upload failed, retrying digest=%s: %s", digest, error)
            else:
                return
            await asyncio.sleep(wait_s)
            wait_s = min(2 * wait_s, MAX_RETRY_S)

    def report(self, report: TrainingReport) -> None:
        """Queue a report for the dashboard without waiting. Rejected reports are logged and dropped."""
        self._reports.append(report)
        asyncio.run_coroutine_threadsafe(self._send_reports(), self._loop)

    async def _send_reports(self) -> None:
        async with self._reporting:
            while self._reports:
                report = self._reports[0]
                try:
                    await self._cluster.report_training(self.run_id, report)
                except (UnavailableError, DeadlineError):
                    return  # the next report retries the queue
                except PreconditionError as error:
                    logger.warning("training reports disabled, the manager rejects them: %s", error)
                    self._reports = deque(maxlen=0)
                except ClusterError as error:
                    logger.warning("training report rejected: %s", error)
                # A newer report may have evicted this one from the full queue.
                if self._reports and self._reports[0] is report:
                    self._reports.popleft()

    def submit(
        self, batch_id: str, step: int, groups: Sequence[PlanGroup], codec: Codec
    ) -> list[Future[tuple[PlanOutcome, ...]]]:
        """Start the rollouts of these groups as one batch. Return a future for each group.

        Its outcomes keep the order of the group's texts, and come as soon as the group is complete.
        """
        pending = [
            _PendingGroup(
                f"{self.run_id}/{batch_id}/{row}",
                group,
                [_plan_or_failure(text, group.situation, codec, self._terms.reward) for text in group.texts],
            )
            for row, group in enumerate(groups)
        ]
        rollouts = tuple(rollout for one in pending for rollout in one.rollouts())
        batch = Batch(self.run_id, batch_id, step, rollouts)
        asyncio.run_coroutine_threadsafe(self._execute(batch, pending), self._loop)
        return [one.future for one in pending]

    async def _execute(self, batch: Batch, pending: Sequence[_PendingGroup]) -> None:
        try:
            groups = {one.group_id: one for one in pending}
            for one in pending:
                one.settle_if_complete()
            if batch.rollouts:
                self._on_submit(batch)
                for digest in dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts):
                    await self._upload_once(digest)
                async for result in self._cluster.execute(batch):
                    groups[result.group_id].take(result)
        except BaseException as error:
            for one in pending:
                one.fail(error)
            if not isinstance(error, ClusterError):
                raise


def _plan_or_failure(
    text: str, situation: Situation, codec: Codec, reward: RewardSettings
) -> Plan | PlanOutcome:
    try:
        return parse_policy_text(text, situation, codec)
    except PlanError as error:
        return PlanOutcome(text, unparsable(reward), problem=str(error))


def _plan_outcome(text: str, outcome: Outcome | None) -> PlanOutcome:
    if isinstance(outcome, Completed):
        return PlanOutcome(text, outcome.reward, outcome)
    return PlanOutcome(text, None, outcome)


def refuse_without_workers(outcomes: Iterable[PlanOutcome], activity: str) -> None:
    """Raise TrainerError if every submitted rollout was lost, and any of them because no worker took it.

    Without this check a run would spend its budget while it learns nothing. ``activity`` names the outcomes in the message.
    """
    submitted = [each for each in outcomes if not each.problem]
    if any(each.reward is not None for each in submitted):
        return
    failures = [each.outcome for each in submitted if isinstance(each.outcome, InfraFailure)]
    for failure in failures:
        if failure.code is InfraCode.NO_CAPACITY:
            raise TrainerError(
                f"none of the {len(submitted)} rollouts of {activity} has a result: {failure.message}. Then continue the "
                "run with --resume and the same --out"
            )


def result_of(future: Future[T]) -> T:
    """Wait for the future's value. A ClusterError becomes a TrainerError."""
    try:
        return future.result()
    except ClusterError as error:
        raise TrainerError(str(error)) from error
