"""One step of GRPO, which hides simulation behind sampling and back-propagation.

Microbatches (chunks of tasks) are sampled one after the other, and each one's plans go to the cluster at once. With
``Overlap.STREAM`` a process back-propagates its microbatches in turn, each as soon as its rewards are there, followed by one
optimiser step. The gradient is on-policy and covers the whole batch. Its order of summation is fixed, so it does not
depend on which worker was faster.
``Overlap.AHEAD`` also samples the next step's plans before this step's rewards are needed, from weights that are one step
old.

Further passes over the batch, and all passes with several minibatches, begin when all rewards are there.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import torch

from embomatrix.trainer.cluster.gateway import PlanOutcome, refuse_without_workers
from embomatrix.trainer.config.settings import GrpoSettings, LossKind, Overlap
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.grpo.batch import (
    ScoredGroup,
    microbatch_of,
    microbatch_totals,
    microbatches_of,
    minibatches_of,
    scored_groups,
)
from embomatrix.trainer.grpo.records import GroupLog, StepRecord, record_of
from embomatrix.trainer.grpo.sampling import SampledChunk, Sampler
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner
from embomatrix.trainer.learning.gradient import FiniteGradients, Gradient, GradientSum
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.learning.objective import LossMetrics, LossTotals, loss_divisor
from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts
from embomatrix.trainer.lifecycle.stopwatch import Activity, Stopwatch
from embomatrix.trainer.policy.protocol import Policy


@dataclass(frozen=True, slots=True)
class StepPlan:
    """Input of one step. ``rng`` returns a step's generator for prompt variation; ``generator`` draws the tokens.
    ``order`` returns a step's generator for the division into minibatches. ``seed_of`` returns the seed of a task's rollouts
    in a step.

    ``upcoming`` are the next step's tasks, sampled now with ``Overlap.AHEAD``. ``reserve`` tasks replace zero-variance
    groups, in this order. ``rate_factor`` scales the learning rate, ``relevance`` the reward's relevance tier.
    """

    step: int
    tasks: Sequence[TrainingTask]
    upcoming: Sequence[TrainingTask]
    reserve: Sequence[TrainingTask]
    rng: Callable[[int], np.random.Generator]
    generator: torch.Generator
    order: Callable[[int], np.random.Generator]
    seed_of: Callable[[int, str], int]
    rate_factor: float
    relevance: float = 1.0


class Updater:
    """Takes GRPO steps on one policy, which is the policy of the data-parallel workers.

    ``is_between_updates`` is true after an error between two updates of a step: the weights then belong to no step.
    """

    def __init__(
        self,
        policy: Policy,
        workers: DataParallelWorkers,
        sampler: Sampler,
        settings: GrpoSettings,
        stopwatch: Stopwatch,
    ) -> None:
        self._policy = policy
        self._settings = settings
        self._stopwatch = stopwatch
        self._workers = workers
        self._gradient = GradientSum(policy, workers)
        self._sampler = sampler
        self._ahead: tuple[int, list[SampledChunk]] | None = None
        self._finite = FiniteGradients(
            "start a new run with a lower grpo.learning_rate, from this run's folder `reference` (--model) and with "
            "--imitate-seconds=0"
        )
        self.is_between_updates = False
        self.optimiser = torch.optim.AdamW(
            policy.parameters(), lr=settings.learning_rate, betas=(0.9, 0.95), weight_decay=0.0
        )

    def take_step(
        self, plan: StepPlan, interrupts: DeferredInterrupts | None = None
    ) -> tuple[StepRecord, list[GroupLog]]:
        """Sample, execute and learn from one batch of tasks. Ctrl-C is deferred while the weights change.

        Raises TrainerError if the cluster or a process failed, no worker took a rollout, or the gradients stay non-finite.
        """
        settings = self._settings
        with self._stopwatch.track(Activity.SAMPLING):
            chunks = self._chunks(plan)
        state = _StepState(plan, self._totals(chunks))
        self._gradient.clear()
        streams = settings.minibatches == 1  # the first update needs all chunks, in any order
        take = self._learn_all if streams else self._score_all
        take(chunks, state)
        self._replace_zero_variance(len(chunks), state, take)
        outcomes = (outcome for group in state.groups for outcome in group.log.outcomes)
        refuse_without_workers(outcomes, f"step {plan.step}")
        with self._stopwatch.track(Activity.UPDATE):
            if interrupts is not None:
                interrupts.defer()
            if streams:
                self._scale_to_signal(state)
                self._apply(state)
            order = plan.order(plan.step)
            for _ in range(settings.updates_per_batch - streams):
                self._learn_again(state, order)
        self.is_between_updates = False
        logs = [group.log for group in state.groups]
        rate = settings.learning_rate * plan.rate_factor
        return record_of(plan.step, logs, state.metrics, state.norms, rate), logs

    def _chunks(self, plan: StepPlan) -> list[SampledChunk]:
        """Return this step's chunks, sampled now or one step ago. With ``AHEAD``, also sample the next step's."""
        ready, self._ahead = self._ahead, None
        if ready is None or ready[0] != plan.step:
            chunks = self._sample_now(plan, plan.tasks)
        elif self._settings.truncate_ratio is not None:
            chunks = self._sampler.with_old_logprobs(ready[1])
        else:
            chunks = ready[1]
        if self._settings.overlap is Overlap.AHEAD and plan.upcoming:
            coming = plan.step + 1
            self._ahead = coming, self._sample(plan, coming, plan.upcoming)
        return chunks

    def _sample_now(
        self, plan: StepPlan, tasks: Sequence[TrainingTask], first_index: int = 0
    ) -> list[SampledChunk]:
        """Sample for this step. Log-probabilities of a model server differ from those of the policy, which are added."""
        chunks = self._sample(plan, plan.step, tasks, first_index)
        if self._sampler.is_served and self._settings.truncate_ratio is not None:
            return self._sampler.with_old_logprobs(chunks)
        return chunks

    def _sample(
        self, plan: StepPlan, step: int, tasks: Sequence[TrainingTask], first_index: int = 0
    ) -> list[SampledChunk]:
        rng = plan.rng(step)
        chunks = self._sampler.sample(step, tasks, rng, plan.generator, plan.seed_of, first_index=first_index)
        self._stopwatch.move(sum(chunk.waited_s for chunk in chunks), Activity.SAMPLING, Activity.WAITING)
        return chunks

    def _totals(self, chunks: Sequence[SampledChunk]) -> LossTotals:
        return LossTotals(
            plans=sum(chunk.plans for chunk in chunks),
            tokens=sum(chunk.tokens for chunk in chunks),
            longest=self._settings.max_new,
            microbatches=len(chunks),
        )

    def _learn_all(self, chunks: Sequence[SampledChunk], state: _StepState) -> None:
        """Back-propagate the chunks in order, each as soon as its rewards are there unless ``Overlap.NONE``.

        Floating-point sums depend on their order. A fixed order makes a step bit-identical whichever worker was faster.
        """
        if self._settings.overlap is Overlap.NONE:
            self._wait(chunks)
        remote_chunks = {
            chunk.index: _RemoteChunk(chunk, remote, functools.partial(self._learn, chunk, state))
            for chunk in chunks
            if (remote := self._workers.remote(chunk.index)) is not None
        }
        learnt: dict[int, _LearntChunk] = {}
        # Remote chunks come last: this process does not wait for another one before its own work is done.
        for chunk in sorted(chunks, key=lambda chunk: chunk.index in remote_chunks):
            self._wait([chunk])
            with self._stopwatch.track(Activity.UPDATE):
                if chunk.index in remote_chunks:
                    learnt[chunk.index] = remote_chunks[chunk.index].result()
                else:
                    learnt[chunk.index] = self._learn(chunk, state, self._workers.local)
        with self._stopwatch.track(Activity.UPDATE):
            for chunk in chunks:
                state.count(learnt[chunk.index])
                self._gradient.add(learnt[chunk.index].gradient)

    def _score_all(self, chunks: Sequence[SampledChunk], state: _StepState) -> None:
        """Wait for the rewards of all chunks, and keep their groups for minibatches."""
        self._wait(chunks)
        for chunk in chunks:
            state.groups += self._scored(chunk, state)

    def _wait(self, chunks: Sequence[SampledChunk]) -> None:
        with self._stopwatch.track(Activity.WAITING):
            for chunk in chunks:
                chunk.outcomes()

    def _scored(self, chunk: SampledChunk, state: _StepState) -> list[ScoredGroup]:
        return scored_groups(chunk, chunk.outcomes(), self._settings, state.plan.relevance)

    def _learn(
        self, chunk: SampledChunk, state: _StepState, learner: Learner | RemoteLearner
    ) -> _LearntChunk:
        """Back-propagate the groups of a chunk that have a gradient."""
        groups = self._scored(chunk, state)
        learning = [group for group in groups if group.learns]
        if not learning:
            return _LearntChunk(groups)
        totals = microbatch_totals(state.totals, chunk.tokens, self._settings.loss)
        metrics, gradient = self._gradient.learn(microbatch_of(learning, totals), learner)
        return _LearntChunk(groups, metrics, gradient)

    def _learn_again(self, state: _StepState, order: np.random.Generator) -> None:
        """Pass over the groups of the step once, with one update for each minibatch."""
        groups = [group for group in state.groups if group.learns or not state.plan.reserve]
        for minibatch in minibatches_of(groups, self._settings.minibatches, order):
            self._gradient.clear()
            learnt = self._workers.map(
                [
                    (index, functools.partial(self._gradient.learn, microbatch))
                    for index, microbatch in microbatches_of(minibatch, self._settings)
                ]
            )
            for metrics, gradient in learnt:
                state.metrics.append(metrics)
                self._gradient.add(gradient)
            if learnt:
                self._apply(state)

    def _replace_zero_variance(
        self,
        next_index: int,
        state: _StepState,
        take: Callable[[Sequence[SampledChunk], _StepState], None],
    ) -> None:
        """Replace zero-variance groups from the reserve. ``take`` learns from the sampled chunks or keeps their groups."""
        plan, reserve = state.plan, list(state.plan.reserve)
        replaced = 0
        while reserve and (missing := sum(group.log.zero_variance for group in state.groups) - replaced) > 0:
            tasks, reserve = reserve[:missing], reserve[missing:]
            replaced += len(tasks)
            with self._stopwatch.track(Activity.SAMPLING):
                chunks = self._sample_now(plan, tasks, next_index)
            next_index += len(chunks)
            take(chunks, state)

    def _scale_to_signal(self, state: _StepState) -> None:
        """Rescale the gradient from all groups of the step to those with a signal, if there is a reserve.

        Tokens of lost plans count, as they do without a reserve. BNPO's microbatches keep their own denominators.
        """
        learning = [group for group in state.groups if group.learns]
        if not state.plan.reserve or not learning:
            return
        kind = self._settings.loss
        final = LossTotals(
            plans=len(learning) * self._settings.group,
            tokens=sum(group.counted for group in learning),
            longest=self._settings.max_new,
            microbatches=len(state.metrics),
        )
        if kind is LossKind.BNPO:
            self._gradient.scale(state.totals.microbatches / final.microbatches)
        else:
            self._gradient.scale(loss_divisor(kind, state.totals) / loss_divisor(kind, final))

    def _apply(self, state: _StepState) -> None:
        """Take an optimiser step, unless there is no gradient or it is not finite."""
        if not state.metrics:
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self._settings.learning_rate * state.plan.rate_factor
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._settings.max_grad_norm))
        state.norms.append(norm)
        if self._finite.may_apply(norm, state.plan.step):
            self.is_between_updates = True
            self.optimiser.step()


@dataclass(frozen=True, slots=True)
class _LearntChunk:
    """Back-propagated chunk. ``metrics`` is None without a gradient, ``gradient`` if it is already in the step's sum."""

    groups: list[ScoredGroup]
    metrics: LossMetrics | None = None
    gradient: Gradient | None = None


class _RemoteChunk:
    """Chunk that is sent to a remote learner as soon as its rewards are complete, exactly once."""

    def __init__(
        self,
        chunk: SampledChunk,
        remote: RemoteLearner,
        job: Callable[[RemoteLearner], _LearntChunk],
    ) -> None:
        self._chunk = chunk
        self._remote = remote
        self._job = job
        self._lock = threading.Lock()
        self._future: Future[_LearntChunk] | None = None
        for future in chunk.futures:
            future.add_done_callback(self._on_reward)

    def _on_reward(self, _: Future[tuple[PlanOutcome, ...]]) -> None:
        """Runs on the thread that receives the reward. Rewards that arrive after shutdown are ignored."""
        if self._chunk.is_complete and not self._remote.closed:
            self._send()

    def _send(self) -> Future[_LearntChunk]:
        with self._lock:
            if self._future is None:
                self._future = self._remote.run(self._job)
            return self._future

    def result(self) -> _LearntChunk:
        """Wait for the result. The chunk's rewards must be complete."""
        return self._send().result()


class _StepState:
    """Groups of a step so far, the metrics of its microbatches, and the gradient norms of its updates."""

    def __init__(self, plan: StepPlan, totals: LossTotals) -> None:
        self.plan = plan
        self.totals = totals
        self.groups: list[ScoredGroup] = []
        self.metrics: list[LossMetrics] = []
        self.norms: list[float] = []

    def count(self, learnt: _LearntChunk) -> None:
        self.groups += learnt.groups
        if learnt.metrics is not None:
            self.metrics.append(learnt.metrics)
