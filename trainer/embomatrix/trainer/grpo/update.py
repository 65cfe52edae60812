"""One optimiser step of GRPO, with simulation hidden behind sampling and back-propagation.

Chunks of tasks are sampled one after the other; each chunk's plans go to the cluster at once. With ``Overlap.STREAM`` chunks
are back-propagated as their rewards arrive, with one optimiser step at the end: the gradient is that of the whole batch,
on-policy, summed in the order of sampling, so that it does not depend on which worker was faster. ``Overlap.AHEAD`` also
samples the next step's plans before this step's rewards are needed, from weights that are one step old.

Chunks belong to the processes of a crew; their gradients are added in the same order wherever they come from.
"""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import OnLost, Overlap
from embomatrix.trainer.grpo.gradients import GradientSum
from embomatrix.trainer.grpo.learner import Lesson
from embomatrix.trainer.grpo.objective import LossKind, LossMetrics, Scale, divisor, group_advantages
from embomatrix.trainer.grpo.records import GroupLog, StepRecord, record_of
from embomatrix.trainer.grpo.sampling import Sampler, next_back
from embomatrix.trainer.lifecycle.stopwatch import Activity

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future

    import numpy as np

    from embomatrix.trainer.cluster.gateway import PlanOutcome, Submitting
    from embomatrix.trainer.config.settings import GrpoSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.grpo.data_parallel import Crew, RemoteLearner
    from embomatrix.trainer.grpo.sampling import SampledChunk
    from embomatrix.trainer.lifecycle.interrupts import Interrupts
    from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
    from embomatrix.trainer.policy.prompts import Teller
    from embomatrix.trainer.policy.protocol import Policy

GRADIENTS_ASIDE = 2
"""Chunks back-propagated before their turn, at most: each keeps a gradient of the policy's size."""
BAD_GRADIENTS = 5
"""Steps in a row whose gradient is not finite: the run has gone astray."""


@dataclass(frozen=True, slots=True)
class StepPlan:
    """What one step works on. ``rng`` gives a step's generator for tellings; ``generator`` draws the tokens.

    ``upcoming`` are the next step's tasks, sampled now with ``Overlap.AHEAD``; ``reserve`` may replace groups that carry no
    signal, in this order. ``rate_factor`` scales the learning rate, ``relevance`` the reward's second tier.
    """

    step: int
    tasks: Sequence[TrainingTask]
    upcoming: Sequence[TrainingTask]
    reserve: Sequence[TrainingTask]
    rng: Callable[[int], np.random.Generator]
    generator: torch.Generator
    rate_factor: float
    relevance: float = 1.0


class Updater:
    """Takes steps on one policy, which is that of the crew."""

    def __init__(
        self,
        policy: Policy,
        crew: Crew,
        teller: Teller,
        gateway: Submitting,
        settings: GrpoSettings,
        stopwatch: Stopwatch,
    ) -> None:
        self._policy = policy
        self._settings = settings
        self._stopwatch = stopwatch
        self._crew = crew
        self._sampler = Sampler(crew, policy.codec, teller, gateway, settings)
        self._ahead: tuple[int, list[SampledChunk]] | None = None
        self._bad_gradients = 0
        self.optimiser = torch.optim.AdamW(
            policy.parameters(), lr=settings.learning_rate, betas=(0.9, 0.95), weight_decay=0.0
        )

    def take_step(
        self, plan: StepPlan, interrupts: Interrupts | None = None
    ) -> tuple[StepRecord, list[GroupLog]]:
        """Sample, execute and learn from one batch of tasks. Raises TrainerError where it can't go on.

        ``interrupts`` are put off once the policy moves.
        """
        with self._stopwatch.spending(Activity.SAMPLING):
            chunks = self._chunks(plan)
        work = _Work(plan, self._scale(chunks), GradientSum(self._policy.parameters()))
        self._learn_all(chunks, work)
        self._replace_dead(len(chunks), work)
        with self._stopwatch.spending(Activity.UPDATE):
            if interrupts is not None:
                interrupts.put_off()
            norm, rate = self._apply(work)
        return record_of(plan.step, work.logs, work.metrics, norm, rate), work.logs

    def _chunks(self, plan: StepPlan) -> list[SampledChunk]:
        """This step's chunks, sampled now or a step ago; those of the next step are sent on their way too."""
        ready, self._ahead = self._ahead, None
        if ready is not None and ready[0] == plan.step:
            chunks = ready[1]
        else:
            chunks = self._sampler.sample(plan.step, plan.tasks, plan.rng(plan.step), plan.generator)
        if self._settings.overlap is Overlap.AHEAD and plan.upcoming:
            coming = plan.step + 1
            self._ahead = (
                coming,
                self._sampler.sample(coming, plan.upcoming, plan.rng(coming), plan.generator),
            )
        return chunks

    def _scale(self, chunks: Sequence[SampledChunk]) -> Scale:
        return Scale(
            plans=sum(chunk.plans for chunk in chunks),
            tokens=sum(chunk.tokens for chunk in chunks),
            longest=self._settings.max_new,
            parts=len(chunks),
        )

    def _learn_all(self, chunks: Sequence[SampledChunk], work: _Work) -> None:
        """Back-propagate every chunk, as its rewards arrive where that is wanted."""
        if self._settings.overlap is Overlap.NONE:
            with self._stopwatch.spending(Activity.WAITING):
                for chunk in chunks:
                    chunk.outcomes()
        elsewhere = {
            chunk.part: _Sent(chunk, helper, functools.partial(self._learn_elsewhere, chunk, work))
            for chunk in chunks
            if (helper := self._crew.helper(chunk.part)) is not None
        }
        logs = self._learn_here([chunk for chunk in chunks if chunk.part not in elsewhere], work)
        for chunk in chunks:
            if chunk.part in elsewhere:
                with self._stopwatch.spending(Activity.WAITING):
                    chunk.outcomes()
                with self._stopwatch.spending(Activity.UPDATE):
                    logs[chunk.part] = self._taken_over(chunk.part, elsewhere[chunk.part].learnt(), work)
        for part in sorted(logs):
            work.logs += logs[part]

    def _learn_here(self, chunks: Sequence[SampledChunk], work: _Work) -> dict[int, list[GroupLog]]:
        """Back-propagate this process's chunks, the first that is back first."""
        logs: dict[int, list[GroupLog]] = {}
        waiting = list(chunks)
        while waiting:
            # The first in line waits alone once enough gradients are kept for later.
            open_ones = waiting[:1] if work.gradients.aside >= GRADIENTS_ASIDE else waiting
            with self._stopwatch.spending(Activity.WAITING):
                chunk = next_back(open_ones)
                outcomes = chunk.outcomes()
            waiting.remove(chunk)
            with self._stopwatch.spending(Activity.UPDATE):
                lesson, logs[chunk.part] = self._lesson(chunk, outcomes, work)
                work.gradients.add(chunk.part, functools.partial(self._learn, lesson, work))
        return logs

    def _learn(self, lesson: Lesson | None, work: _Work) -> None:
        if lesson is not None:
            work.count(self._crew.own.learn(lesson), len(lesson.tokens))

    def _learn_elsewhere(self, chunk: SampledChunk, work: _Work, helper: RemoteLearner) -> _Elsewhere:
        """A chunk's share, once its rewards are there, as a helper finds it."""
        lesson, logs = self._lesson(chunk, chunk.outcomes(), work)
        if lesson is None:
            return _Elsewhere(logs, None, 0, None)
        metrics, gradient = helper.learn(lesson)
        return _Elsewhere(logs, metrics, len(lesson.tokens), gradient)

    def _taken_over(self, part: int, found: _Elsewhere, work: _Work) -> list[GroupLog]:
        work.gradients.put(part, found.gradient)
        if found.metrics is not None:
            work.count(found.metrics, found.plans)
        return found.logs

    def _replace_dead(self, part: int, work: _Work) -> None:
        """Groups without signal are replaced from the reserve, round by round, and the sum is scaled to what carries one."""
        plan, reserve = work.plan, list(work.plan.reserve)
        if not reserve:
            return
        replaced = 0
        while reserve and (missing := sum(log.dead for log in work.logs) - replaced) > 0:
            tasks, reserve = reserve[:missing], reserve[missing:]
            replaced += len(tasks)
            with self._stopwatch.spending(Activity.SAMPLING):
                chunks = self._sampler.sample(
                    plan.step, tasks, plan.rng(plan.step), plan.generator, first_part=part
                )
            part += len(chunks)
            self._learn_all(chunks, work)
        if work.live_plans:
            kind = self._settings.loss
            final = Scale(work.live_plans, work.live_tokens, self._settings.max_new, work.live_parts)
            if kind is LossKind.BNPO:
                work.gradients.scale(work.scale.parts / final.parts)
            else:
                work.gradients.scale(divisor(kind, work.scale) / divisor(kind, final))

    def _lesson(
        self, chunk: SampledChunk, outcomes: Sequence[tuple[PlanOutcome, ...]], work: _Work
    ) -> tuple[Lesson | None, list[GroupLog]]:
        """What the groups of a chunk that carry a signal have to teach; None where none does."""
        rewards = torch.tensor(
            [[outcome.valued(work.plan.relevance) for outcome in each] for each in outcomes]
        )  # (tasks, G)
        if self._settings.on_lost is OnLost.GROUP:
            rewards[torch.isnan(rewards).any(dim=1)] = math.nan
        advantages = group_advantages(rewards, self._settings.spread_floor)
        live = [row for row, dead in enumerate(advantages.dead.tolist()) if not dead]
        logs = [
            GroupLog(task, each, tuple(values), dead)
            for task, each, values, dead in zip(
                chunk.tasks, outcomes, advantages.values.tolist(), advantages.dead.tolist(), strict=True
            )
        ]
        if not live:
            return None, logs
        return self._lesson_of(chunk, live, rewards, advantages.values, work.scale), logs

    def _lesson_of(
        self,
        chunk: SampledChunk,
        live: Sequence[int],
        rewards: torch.Tensor,
        advantages: torch.Tensor,
        scale: Scale,
    ) -> Lesson:
        """The groups of the rows ``live``, in which rollouts that were lost have no word."""
        group, samples = self._settings.group, chunk.samples
        device = samples.tokens.device
        rows = torch.tensor([row * group + sample for row in live for sample in range(group)], device=device)
        known = ~torch.isnan(rewards[live].view(-1)).to(device)
        length = int(samples.mask[rows].sum(dim=1).max())
        mask = samples.mask[rows, :length] & known[:, None]
        return Lesson(
            prompts=[chunk.told[row].prompt for row in live],
            tokens=samples.tokens[rows, :length],
            mask=mask,
            old_logprobs=samples.logprobs[rows, :length],
            reference=None if chunk.reference is None else chunk.reference[rows, :length],
            advantages=advantages[live].view(-1).to(device),
            scale=self._scale_of(chunk, scale),
        )

    def _scale_of(self, chunk: SampledChunk, scale: Scale) -> Scale:
        """BNPO divides by the part's own tokens, and averages over parts."""
        if self._settings.loss is not LossKind.BNPO:
            return scale
        return Scale(scale.plans, chunk.tokens * scale.parts, scale.longest, scale.parts)

    def _apply(self, work: _Work) -> tuple[float, float]:
        """Move the policy, unless nothing was learnt or the gradient is not finite; returns its norm and the rate."""
        rate = self._settings.learning_rate * work.plan.rate_factor
        if not work.metrics:
            return 0.0, rate
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._settings.max_grad_norm))
        if math.isfinite(norm):
            self._bad_gradients = 0
            self.optimiser.step()
            return norm, rate
        self._bad_gradients += 1
        if self._bad_gradients >= BAD_GRADIENTS:
            raise TrainerError(
                f"the gradient of step {work.plan.step} is not finite (found {norm}), the {BAD_GRADIENTS}th time in a row: the "
                "policy was left as it is; lower grpo.learning_rate and go on with --resume"
            )
        return norm, rate


@dataclass(frozen=True, slots=True)
class _Elsewhere:
    """What came of a chunk in another process: its groups, and the share of ``plans`` with a signal, if there are any."""

    logs: list[GroupLog]
    metrics: LossMetrics | None
    plans: int
    gradient: Sequence[torch.Tensor | None] | None


class _Sent:
    """A chunk that goes to a helper as soon as its rewards are there, whoever sees that first."""

    def __init__(
        self, chunk: SampledChunk, helper: RemoteLearner, job: Callable[[RemoteLearner], _Elsewhere]
    ) -> None:
        self._chunk = chunk
        self._helper = helper
        self._job = job
        self._lock = threading.Lock()
        self._future: Future[_Elsewhere] | None = None
        for future in chunk.futures:
            future.add_done_callback(self._heard)

    def _heard(self, _: Future[tuple[PlanOutcome, ...]]) -> None:
        """In whichever thread hears of a reward; after the end of the crew nobody wants it."""
        if self._chunk.is_back and not self._helper.closed:
            self._begun()

    def _begun(self) -> Future[_Elsewhere]:
        with self._lock:
            if self._future is None:
                self._future = self._helper.run(self._job)
            return self._future

    def learnt(self) -> _Elsewhere:
        """What came of it; its rewards are there."""
        return self._begun().result()


class _Work:
    """What a step has gathered so far."""

    def __init__(self, plan: StepPlan, scale: Scale, gradients: GradientSum) -> None:
        self.plan = plan
        self.scale = scale
        self.gradients = gradients
        self.logs: list[GroupLog] = []
        self.metrics: list[LossMetrics] = []
        self.live_plans = 0
        self.live_tokens = 0
        self.live_parts = 0

    def count(self, metrics: LossMetrics, plans: int) -> None:
        """One more part with a signal."""
        self.metrics.append(metrics)
        self.live_plans += plans
        self.live_tokens += metrics.weight
        self.live_parts += 1
