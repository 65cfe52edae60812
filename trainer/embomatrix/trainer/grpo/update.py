"""One optimiser step of GRPO that hides simulation behind sampling and back-propagation.

Microbatches (chunks of tasks) are sampled one after the other, and each one's plans go to the cluster at once. With
``Overlap.STREAM`` a process back-propagates its microbatches in turn, each as soon as its rewards are there, followed by one
optimiser step. The gradient is on-policy and covers the whole batch. Its order of summation is fixed, so it does not
depend on which worker was faster.
``Overlap.AHEAD`` also samples the next step's plans before this step's rewards are needed, from weights that are one step
old.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import torch

from embomatrix.trainer.cluster.gateway import PlanOutcome, PlanSubmitter
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import GrpoSettings, LossKind, OnLost, Overlap
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.grpo.data_parallel import DataParallelWorkers, RemoteLearner
from embomatrix.trainer.grpo.learner import Microbatch
from embomatrix.trainer.grpo.objective import LossMetrics, LossTotals, group_advantages, loss_divisor
from embomatrix.trainer.grpo.records import GroupLog, StepRecord, record_of
from embomatrix.trainer.grpo.sampling import SampledChunk, Sampler
from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts
from embomatrix.trainer.lifecycle.stopwatch import Activity, Stopwatch
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.protocol import Policy

MAX_BAD_GRADIENTS = 5
"""Consecutive steps with a non-finite gradient before the run ends: it has diverged."""


@dataclass(frozen=True, slots=True)
class StepPlan:
    """Input of one step. ``rng`` returns a step's generator for prompt variation; ``generator`` draws the tokens.
    ``seed_of`` returns the seed of a task's rollouts in a step.

    ``upcoming`` are the next step's tasks, sampled now with ``Overlap.AHEAD``. ``reserve`` tasks replace zero-variance
    groups, in this order. ``rate_factor`` scales the learning rate, ``relevance`` the reward's relevance tier.
    """

    step: int
    tasks: Sequence[TrainingTask]
    upcoming: Sequence[TrainingTask]
    reserve: Sequence[TrainingTask]
    rng: Callable[[int], np.random.Generator]
    generator: torch.Generator
    seed_of: Callable[[int, str], int]
    rate_factor: float
    relevance: float = 1.0


class Updater:
    """Takes GRPO steps on one policy, which is the policy of the data-parallel workers."""

    def __init__(
        self,
        policy: Policy,
        workers: DataParallelWorkers,
        prompt_builder: PromptBuilder,
        gateway: PlanSubmitter,
        settings: GrpoSettings,
        stopwatch: Stopwatch,
    ) -> None:
        self._policy = policy
        self._settings = settings
        self._stopwatch = stopwatch
        self._workers = workers
        self._sampler = Sampler(workers, policy.codec, prompt_builder, gateway, settings)
        self._ahead: tuple[int, list[SampledChunk]] | None = None
        self._bad_gradients = 0
        self.optimiser = torch.optim.AdamW(
            policy.parameters(), lr=settings.learning_rate, betas=(0.9, 0.95), weight_decay=0.0
        )

    def take_step(
        self, plan: StepPlan, interrupts: DeferredInterrupts | None = None
    ) -> tuple[StepRecord, list[GroupLog]]:
        """Sample, execute and learn from one batch of tasks. Ctrl-C is deferred while the weights change.

        Raises TrainerError if the cluster or a process failed, or the gradients stay non-finite.
        """
        with self._stopwatch.track(Activity.SAMPLING):
            chunks = self._chunks(plan)
        state = _StepState(plan, self._totals(chunks))
        self.optimiser.zero_grad()
        self._learn_all(chunks, state)
        self._replace_zero_variance(len(chunks), state)
        with self._stopwatch.track(Activity.UPDATE):
            if interrupts is not None:
                interrupts.defer()
            norm, rate = self._apply(state)
        return record_of(plan.step, state.logs, state.metrics, norm, rate), state.logs

    def _chunks(self, plan: StepPlan) -> list[SampledChunk]:
        """Return this step's chunks, sampled now or one step ago. With ``AHEAD``, also sample the next step's."""
        ready, self._ahead = self._ahead, None
        step, chunks = ready or (0, [])
        if step != plan.step:
            chunks = self._sample(plan, plan.step, plan.tasks)
        if self._settings.overlap is Overlap.AHEAD and plan.upcoming:
            coming = plan.step + 1
            self._ahead = coming, self._sample(plan, coming, plan.upcoming)
        return chunks

    def _sample(
        self, plan: StepPlan, step: int, tasks: Sequence[TrainingTask], first_index: int = 0
    ) -> list[SampledChunk]:
        rng = plan.rng(step)
        return self._sampler.sample(step, tasks, rng, plan.generator, plan.seed_of, first_index=first_index)

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
            with self._stopwatch.track(Activity.WAITING):
                for chunk in chunks:
                    chunk.outcomes()
        remote_chunks = {
            chunk.index: _RemoteChunk(chunk, remote, functools.partial(self._learn_remotely, chunk, state))
            for chunk in chunks
            if (remote := self._workers.remote(chunk.index)) is not None
        }
        learnt: dict[int, _LearntChunk] = {}
        # Remote chunks come last: this process does not wait for another one before its own work is done.
        for chunk in sorted(chunks, key=lambda chunk: chunk.index in remote_chunks):
            with self._stopwatch.track(Activity.WAITING):
                chunk.outcomes()
            with self._stopwatch.track(Activity.UPDATE):
                if chunk.index in remote_chunks:
                    learnt[chunk.index] = remote_chunks[chunk.index].result()
                else:
                    learnt[chunk.index] = self._learn_locally(chunk, state, separately=bool(remote_chunks))
        with self._stopwatch.track(Activity.UPDATE):
            for chunk in chunks:
                state.count(learnt[chunk.index])
                if (gradient := learnt[chunk.index].gradient) is not None:
                    self._add_gradient(gradient)

    def _learn_locally(self, chunk: SampledChunk, state: _StepState, *, separately: bool) -> _LearntChunk:
        """Add the chunk's gradient to the step's sum in the parameters; ``separately``: return the gradient instead."""
        microbatch, logs = self._microbatch(chunk, chunk.outcomes(), state)
        if microbatch is None:
            return _LearntChunk(logs)
        if not separately:
            return _LearntChunk(logs, self._workers.local.learn(microbatch), len(microbatch.tokens))
        total = [parameter.grad for parameter in self._policy.parameters()]
        self.optimiser.zero_grad()
        metrics = self._workers.local.learn(microbatch)
        gradient = [parameter.grad for parameter in self._policy.parameters()]
        for parameter, part in zip(self._policy.parameters(), total, strict=True):
            parameter.grad = part
        return _LearntChunk(logs, metrics, len(microbatch.tokens), gradient)

    def _learn_remotely(self, chunk: SampledChunk, state: _StepState, remote: RemoteLearner) -> _LearntChunk:
        microbatch, logs = self._microbatch(chunk, chunk.outcomes(), state)
        if microbatch is None:
            return _LearntChunk(logs)
        metrics, gradient = remote.learn(microbatch)
        return _LearntChunk(logs, metrics, len(microbatch.tokens), gradient)

    def _add_gradient(self, gradient: Sequence[torch.Tensor | None]) -> None:
        """Add a gradient by parameter to the step's sum."""
        for parameter, part in zip(self._policy.parameters(), gradient, strict=True):
            if parameter.grad is None:
                parameter.grad = part
            elif part is not None:
                parameter.grad.add_(part)

    def _scale_gradient(self, factor: float) -> None:
        for parameter in self._policy.parameters():
            if parameter.grad is not None:
                parameter.grad.mul_(factor)

    def _replace_zero_variance(self, next_index: int, state: _StepState) -> None:
        """Replace zero-variance groups from the reserve, then rescale the gradient to the groups with a signal."""
        plan, reserve = state.plan, list(state.plan.reserve)
        if not reserve:
            return
        replaced = 0
        while reserve and (missing := sum(log.zero_variance for log in state.logs) - replaced) > 0:
            tasks, reserve = reserve[:missing], reserve[missing:]
            replaced += len(tasks)
            with self._stopwatch.track(Activity.SAMPLING):
                chunks = self._sample(plan, plan.step, tasks, next_index)
            next_index += len(chunks)
            self._learn_all(chunks, state)
        if state.learnt_plans:
            kind = self._settings.loss
            final = LossTotals(
                plans=state.learnt_plans,
                tokens=sum(metrics.weight for metrics in state.metrics),
                longest=self._settings.max_new,
                microbatches=len(state.metrics),
            )
            if kind is LossKind.BNPO:
                self._scale_gradient(state.totals.microbatches / final.microbatches)
            else:
                self._scale_gradient(loss_divisor(kind, state.totals) / loss_divisor(kind, final))

    def _microbatch(
        self, chunk: SampledChunk, outcomes: Sequence[tuple[PlanOutcome, ...]], state: _StepState
    ) -> tuple[Microbatch | None, list[GroupLog]]:
        """Return the groups to learn from as a microbatch, None if there are none, and the logs of all groups.

        Zero-variance groups are among them if the settings keep their KL and entropy terms, unless all rollouts are lost.
        """
        rewards = torch.tensor(
            [[outcome.weighted_reward(state.plan.relevance) for outcome in group] for group in outcomes]
        )  # (tasks, G)
        if self._settings.on_lost is OnLost.GROUP:
            rewards[torch.isnan(rewards).any(dim=1)] = math.nan
        advantages = group_advantages(rewards, self._settings.spread_floor)
        zero_variance = advantages.zero_variance.tolist()
        logs = [
            GroupLog(task, group, tuple(values), flat)
            for task, group, values, flat in zip(
                chunk.tasks, outcomes, advantages.values.tolist(), zero_variance, strict=True
            )
        ]
        learns = ~advantages.zero_variance
        if self._settings.keeps_zero_variance_groups:
            learns = ~torch.isnan(rewards).all(dim=1)
        kept = [row for row, present in enumerate(learns.tolist()) if present]
        if not kept:
            return None, logs
        group, samples = self._settings.group, chunk.samples
        device = samples.tokens.device
        rows = torch.tensor([row * group + sample for row in kept for sample in range(group)], device=device)
        known = ~torch.isnan(rewards[kept].view(-1)).to(device)  # (plans,)
        length = int(samples.mask[rows].sum(dim=1).max())
        microbatch = Microbatch(
            prompts=[chunk.prompts[row].tokens for row in kept],
            tokens=samples.tokens[rows, :length],
            mask=samples.mask[rows, :length] & known[:, None],
            old_logprobs=samples.logprobs[rows, :length],
            reference=None if chunk.reference is None else chunk.reference[rows, :length],
            advantages=advantages.values[kept].view(-1).to(device),
            totals=self._totals_of(chunk, state.totals),
        )
        return microbatch, logs

    def _totals_of(self, chunk: SampledChunk, totals: LossTotals) -> LossTotals:
        """Return the denominators of a chunk. BNPO divides by the chunk's own tokens."""
        if self._settings.loss is not LossKind.BNPO:
            return totals
        tokens = chunk.tokens * totals.microbatches
        return LossTotals(totals.plans, tokens, totals.longest, totals.microbatches)

    def _apply(self, state: _StepState) -> tuple[float, float]:
        """Take the optimiser step unless there is no gradient or it is not finite. Return its norm and the rate."""
        rate = self._settings.learning_rate * state.plan.rate_factor
        if not state.metrics:
            return 0.0, rate
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._settings.max_grad_norm))
        if math.isfinite(norm):
            self._bad_gradients = 0
            self.optimiser.step()
            return norm, rate
        self._bad_gradients += 1
        if self._bad_gradients >= MAX_BAD_GRADIENTS:
            raise TrainerError(
                f"the gradient norm of step {state.plan.step} is {norm}, not finite for the {MAX_BAD_GRADIENTS}th step in a "
                "row; these steps left the policy unchanged: lower grpo.learning_rate and continue with --resume"
            )
        return norm, rate


@dataclass(frozen=True, slots=True)
class _LearntChunk:
    """Back-propagated chunk. ``metrics`` is None without a gradient, ``gradient`` if it is already in the step's sum."""

    logs: list[GroupLog]
    metrics: LossMetrics | None = None
    plans: int = 0
    gradient: Sequence[torch.Tensor | None] | None = None


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
    """Accumulated groups of a step, and the metrics and plans of its microbatches."""

    def __init__(self, plan: StepPlan, totals: LossTotals) -> None:
        self.plan = plan
        self.totals = totals
        self.logs: list[GroupLog] = []
        self.metrics: list[LossMetrics] = []
        self.learnt_plans = 0

    def count(self, learnt: _LearntChunk) -> None:
        self.logs += learnt.logs
        if learnt.metrics is not None:
            self.metrics.append(learnt.metrics)
            self.learnt_plans += learnt.plans
