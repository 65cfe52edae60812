"""From tasks to plans on their way: chunks of tasks are told, sampled, and sent to the cluster at once."""

from __future__ import annotations

import functools
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import torch

from embomatrix.trainer.cluster.gateway import waited

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Future

    import numpy as np
    from torch import Tensor

    from embomatrix.skills.prompt import Codec
    from embomatrix.trainer.cluster.gateway import PlanOutcome, Submitting
    from embomatrix.trainer.config.settings import GrpoSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.grpo.data_parallel import Crew
    from embomatrix.trainer.grpo.learner import Sampling
    from embomatrix.trainer.policy.prompts import Teller, Told
    from embomatrix.trainer.policy.protocol import Samples

_SEEDS: Final = 2**62


@dataclass(frozen=True, slots=True, eq=False)
class SampledChunk:
    """Tasks sampled together, and the rewards to come. ``part`` numbers the chunks of a step from 0.

    ``reference``: log-probabilities of the reference policy, (plans, tokens) as ``samples``; None where no KL is asked for.
    """

    part: int
    tasks: Sequence[TrainingTask]
    told: Sequence[Told]
    samples: Samples
    futures: Sequence[Future[tuple[PlanOutcome, ...]]]
    reference: Tensor | None

    @property
    def plans(self) -> int:
        return int(self.samples.mask.shape[0])

    @property
    def tokens(self) -> int:
        return int(self.samples.mask.sum())

    @property
    def is_back(self) -> bool:
        """Whether every rollout has its outcome."""
        return all(future.done() for future in self.futures)

    def outcomes(self) -> list[tuple[PlanOutcome, ...]]:
        """Of every task, as soon as they are there. Raises TrainerError where the cluster failed."""
        return [waited(future) for future in self.futures]


class Sampler:
    """Samples a policy on tasks, in all processes of a crew, and has its plans executed meanwhile."""

    def __init__(
        self, crew: Crew, codec: Codec, teller: Teller, gateway: Submitting, settings: GrpoSettings
    ) -> None:
        self._crew = crew
        self._codec = codec
        self._teller = teller
        self._gateway = gateway
        self._settings = settings

    def sample(
        self,
        step: int,
        tasks: Sequence[TrainingTask],
        rng: np.random.Generator,
        generator: torch.Generator,
        *,
        first_part: int = 0,
    ) -> list[SampledChunk]:
        """The tasks in chunks; each is under way before a process samples its next.

        What a chunk draws depends on its number and on ``generator`` alone, whichever process samples it.
        """
        size = self._settings.chunk
        jobs = []
        for part, at in enumerate(range(0, len(tasks), size), start=first_part):
            told = [(task, self._teller.anew(task, rng)) for task in tasks[at : at + size]]
            seed = int(torch.randint(_SEEDS, (), generator=generator, device=generator.device))
            jobs.append((part, functools.partial(self._chunk, step, part, told, seed)))
        chunks = self._crew.spread(jobs)
        if not self._settings.kl_coef:
            return chunks
        # Last, while the cluster works: it needs no reward.
        return self._crew.spread(
            [(chunk.part, functools.partial(_with_reference, chunk)) for chunk in chunks]
        )

    def _chunk(
        self,
        step: int,
        part: int,
        told: Sequence[tuple[TrainingTask, Told]],
        seed: int,
        learner: Sampling,
    ) -> SampledChunk:
        group = self._settings.group
        samples = learner.sample([each.prompt for _, each in told], seed)
        futures = [
            self._gateway.submit(
                f"step-{step}-{part}-{row}",
                step,
                task,
                each.situation,
                samples.texts[row * group : (row + 1) * group],
                self._codec,
            )
            for row, (task, each) in enumerate(told)
        ]
        tasks, tellings = zip(*told, strict=True)
        return SampledChunk(part, tasks, tellings, samples, futures, None)


def _with_reference(chunk: SampledChunk, learner: Sampling) -> SampledChunk:
    prompts = [each.prompt for each in chunk.told]
    scored = learner.of_reference(prompts, chunk.samples.tokens, chunk.samples.mask)
    return replace(chunk, reference=scored)


def next_back(chunks: Sequence[SampledChunk]) -> SampledChunk:
    """The first of the chunks whose rewards are all there; waits until there is one."""
    while True:
        for chunk in chunks:
            if chunk.is_back:
                return chunk
        open_ones = [future for chunk in chunks for future in chunk.futures if not future.done()]
        wait(open_ones, return_when=FIRST_COMPLETED)
