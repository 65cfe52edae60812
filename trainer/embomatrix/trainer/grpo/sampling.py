"""Sampling of plans for a step: microbatches of tasks are sampled, and their plans sent to the cluster at once."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from torch import Tensor

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.cluster.gateway import PlanGroup, PlanOutcome, PlanSubmitter, result_of
from embomatrix.trainer.config.settings import GrpoSettings, Overlong
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.episodes.batches import EpisodeBatch, PlayedBatch, play_batches
from embomatrix.trainer.episodes.client import EpisodeClient, PlannedEpisode
from embomatrix.trainer.grpo.step_advantages import AnswerStates, StepRule
from embomatrix.trainer.learning.learner import SamplingParams
from embomatrix.trainer.policy.prompts import PromptBuilder, TaskPrompt
from embomatrix.trainer.policy.protocol import Samples
from embomatrix.trainer.serving.sampler import Draw, ServerSampler, begin_drawing

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import Gateway
    from embomatrix.trainer.episodes.terms import EpisodeTerms
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner
    from embomatrix.trainer.learning.learner import Learner
    from embomatrix.trainer.policy.protocol import Policy

_SEEDS: Final = 2**62


@dataclass(frozen=True, slots=True, eq=False)
class SampledChunk:
    """Tasks that were sampled together, with the futures of their rewards. ``index`` counts a step's chunks from 0.

    ``mask`` (plans, tokens) is the samples' mask without the plans that ``Overlong.MASK`` leaves out. ``reference``:
    log-probabilities (plans, tokens) of the reference policy, None without a KL term. ``old_logprobs``: those of the policy
    at the beginning of the step, None if they are not needed or the samples' own. A model server's samples need them.
    """

    index: int
    tasks: Sequence[TrainingTask]
    prompts: Sequence[TaskPrompt]
    samples: Samples
    mask: Tensor
    futures: Sequence[Future[tuple[PlanOutcome, ...]]]
    reference: Tensor | None = None
    old_logprobs: Tensor | None = None
    states: AnswerStates | None = None
    """States in which the policy answered, in episodes with step advantages."""
    waited_s: float = 0.0
    """Seconds of sampling in which the trainer's own process waited for the cluster: in episodes."""

    @property
    def plans(self) -> int:
        return int(self.mask.shape[0])

    @property
    def tokens(self) -> int:
        """Tokens in the denominator of the loss."""
        return int(self.mask.sum())

    @property
    def is_complete(self) -> bool:
        """True if every rollout has its outcome."""
        return all(future.done() for future in self.futures)

    def outcomes(self) -> list[tuple[PlanOutcome, ...]]:
        """Wait for the outcomes of every task. Raises TrainerError if the cluster failed."""
        return [result_of(future) for future in self.futures]


@dataclass(frozen=True, slots=True)
class _Part:
    """Tasks of a step that are sampled together, with the seed of their samples. ``index`` counts the parts from 0."""

    index: int
    tasks: Sequence[TrainingTask]
    seed: int


class Sampler:
    """Samples plans on all data-parallel workers, or on a model server, while the cluster executes earlier ones."""

    def __init__(
        self,
        workers: DataParallelWorkers,
        codec: Codec,
        prompt_builder: PromptBuilder,
        gateway: PlanSubmitter,
        settings: GrpoSettings,
        server: ServerSampler | None = None,
    ) -> None:
        self._server = server
        self._workers = workers
        self._codec = codec
        self._prompt_builder = prompt_builder
        self._gateway = gateway
        self._settings = settings

    @property
    def is_served(self) -> bool:
        """True if a model server samples, whose log-probabilities differ from the policy's."""
        return self._server is not None

    def sample(
        self,
        step: int,
        tasks: Sequence[TrainingTask],
        rng: np.random.Generator,
        generator: torch.Generator,
        seed_of: Callable[[int, str], int],
        *,
        first_index: int = 0,
    ) -> list[SampledChunk]:
        """Sample the tasks in chunks. Each chunk is submitted before its process samples the next one.

        A chunk's samples depend only on its index and ``generator``, not on the process that draws them. A model server
        samples all chunks at once. ``seed_of`` returns the seed of a task's rollouts in a step.
        """
        size = self._settings.chunk
        parts = []
        for index, at in enumerate(range(0, len(tasks), size), start=first_index):
            seed = int(torch.randint(_SEEDS, (), generator=generator, device=generator.device))
            parts.append(_Part(index, tasks[at : at + size], seed))
        chunks = self._chunks(step, parts, rng, functools.partial(seed_of, step))
        if not self._settings.kl_coef:
            return chunks
        # The reference pass needs no rewards: it runs last, while the cluster works.
        return self._workers.map(
            [(chunk.index, functools.partial(_with_reference, chunk)) for chunk in chunks]
        )

    def _chunks(
        self, step: int, parts: Sequence[_Part], rng: np.random.Generator, seed_of: Callable[[str], int]
    ) -> list[SampledChunk]:
        """Sample the parts of a step and submit their plans. ``seed_of`` returns the seed of a task's rollouts."""
        rule = SamplingParams.of(self._settings)
        jobs = []
        for part in parts:
            prompts = [(task, self._prompt_builder.varied(task, rng)) for task in part.tasks]
            draw = begin_drawing(self._server, [prompt.tokens for _, prompt in prompts], part.seed, rule)
            jobs.append(
                (part.index, functools.partial(self._chunk, step, part.index, prompts, draw, seed_of))
            )
        return self._workers.map(jobs)

    def with_old_logprobs(self, chunks: Sequence[SampledChunk]) -> list[SampledChunk]:
        """Return chunks that older weights sampled with their log-probabilities under the current ones."""
        return self._workers.map(
            [(chunk.index, functools.partial(_with_old_logprobs, chunk)) for chunk in chunks]
        )

    def _chunk(
        self,
        step: int,
        index: int,
        prompts: Sequence[tuple[TrainingTask, TaskPrompt]],
        draw: Draw,
        seed_of: Callable[[str], int],
        learner: Learner | RemoteLearner,
    ) -> SampledChunk:
        group = self._settings.group
        samples = draw(learner)
        plans = [
            PlanGroup(
                task,
                prompt.situation,
                samples.texts[row * group : (row + 1) * group],
                seed_of(task.task.task_id),
            )
            for row, (task, prompt) in enumerate(prompts)
        ]
        futures = self._gateway.submit(f"step-{step}-{index}", step, plans, self._codec)
        tasks, task_prompts = zip(*prompts, strict=True)
        mask = _mask_of(samples, self._settings)
        return SampledChunk(index, tasks, task_prompts, samples, mask, futures)


class EpisodeSampler(Sampler):
    """Plays episodes on all data-parallel workers. The chunks have their outcomes when ``sample`` returns."""

    def __init__(
        self,
        workers: DataParallelWorkers,
        policy: Policy,
        prompt_builder: PromptBuilder,
        gateway: Gateway,
        settings: GrpoSettings,
        terms: EpisodeTerms,
    ) -> None:
        super().__init__(workers, policy.codec, prompt_builder, gateway, settings)
        self._policy = policy
        self._terms = terms
        self._client = EpisodeClient(gateway, terms, policy.codec)
        self._step_rule = StepRule(terms.step_weight, terms.step_discount) if terms.step_weight else None

    def _chunks(
        self, step: int, parts: Sequence[_Part], rng: np.random.Generator, seed_of: Callable[[str], int]
    ) -> list[SampledChunk]:
        batches = [
            EpisodeBatch(
                part.index,
                [PlannedEpisode(task, seed_of(task.task.task_id)) for task in part.tasks],
                part.seed,
            )
            for part in parts
        ]
        rule = replace(SamplingParams.of(self._settings), max_new=self._terms.answer_tokens)
        played = play_batches(batches, self._workers, self._client, self._policy, rule)
        here = [self._workers.remote(each.batch.index) is None for each in played]
        return [self._chunk_of(each, here=is_here) for each, is_here in zip(played, here, strict=True)]

    def _chunk_of(self, played: PlayedBatch, *, here: bool) -> SampledChunk:
        tasks = [planned.task for planned in played.batch.planned]
        futures = []
        for outcomes in played.outcomes():
            future: Future[tuple[PlanOutcome, ...]] = Future()
            future.set_result(outcomes)
            futures.append(future)
        return SampledChunk(
            played.batch.index,
            tasks,
            [TaskPrompt(task.situation, tokens) for task, tokens in zip(tasks, played.prompts, strict=True)],
            played.samples,
            _mask_of(played.samples, self._settings),
            futures,
            states=AnswerStates(
                self._step_rule,
                [each.states for each in played.episodes],
                [each.rewards_before for each in played.episodes],
            )
            if self._step_rule
            else None,
            waited_s=played.waited_s if here else 0.0,
        )


def _mask_of(samples: Samples, settings: GrpoSettings) -> Tensor:
    """Return the tokens in the loss: (plans, tokens)."""
    return samples.mask & ~samples.cut_off[:, None] if settings.overlong is Overlong.MASK else samples.mask


def _with_reference(chunk: SampledChunk, learner: Learner | RemoteLearner) -> SampledChunk:
    prompts = [prompt.tokens for prompt in chunk.prompts]
    logprobs = learner.reference_logprobs(prompts, chunk.samples.tokens, chunk.samples.mask)
    return replace(chunk, reference=logprobs)


def _with_old_logprobs(chunk: SampledChunk, learner: Learner | RemoteLearner) -> SampledChunk:
    prompts = [prompt.tokens for prompt in chunk.prompts]
    logprobs = learner.current_logprobs(prompts, chunk.samples.tokens, chunk.samples.mask)
    return replace(chunk, old_logprobs=logprobs)
