"""From tasks to plans on their way: chunks of tasks are told, sampled, and sent to the cluster at once."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from embomatrix.trainer.rollout import waited

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Future

    import numpy as np
    from torch import Tensor

    from embomatrix.trainer.data import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy, Samples
    from embomatrix.trainer.rollout import PlanOutcome, Submitting
    from embomatrix.trainer.settings import GrpoSettings
    from embomatrix.trainer.telling import Teller, Told


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
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
    """Samples a policy on tasks, and has its plans executed meanwhile."""

    def __init__(
        self, policy: Policy, reference: Policy, teller: Teller, gateway: Submitting, settings: GrpoSettings
    ) -> None:
        self._policy = policy
        self._reference = reference
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
    ) -> list[Chunk]:
        """The tasks in chunks; each is under way before the next is sampled."""
        size = self._settings.chunk
        chunks = [
            self._chunk(step, first_part + number, tasks[at : at + size], rng, generator)
            for number, at in enumerate(range(0, len(tasks), size))
        ]
        # Last, while the cluster works: it needs no reward.
        return [self._with_reference(chunk) for chunk in chunks] if self._settings.kl_coef else chunks

    def _chunk(
        self,
        step: int,
        part: int,
        tasks: Sequence[TrainingTask],
        rng: np.random.Generator,
        generator: torch.Generator,
    ) -> Chunk:
        settings = self._settings
        told = [self._teller.anew(task, rng) for task in tasks]
        samples = self._policy.sample(
            [each.prompt for each in told], settings.group, settings.temperature, settings.max_new, generator
        )
        futures = [
            self._gateway.submit(
                f"step-{step}-{part}-{row}",
                step,
                task,
                each.situation,
                samples.texts[row * settings.group : (row + 1) * settings.group],
                self._policy.codec,
            )
            for row, (task, each) in enumerate(zip(tasks, told, strict=True))
        ]
        return Chunk(part, tasks, told, samples, futures, None)

    @torch.no_grad()
    def _with_reference(self, chunk: Chunk) -> Chunk:
        scored = self._reference.logprobs(
            [each.prompt for each in chunk.told],
            chunk.samples.tokens,
            chunk.samples.mask,
            self._settings.group,
            self._settings.temperature,
        )
        return Chunk(chunk.part, chunk.tasks, chunk.told, chunk.samples, chunk.futures, scored.logprobs)


def next_back(chunks: Sequence[Chunk]) -> Chunk:
    """The first of the chunks whose rewards are all there; waits until there is one."""
    while True:
        for chunk in chunks:
            if chunk.is_back:
                return chunk
        open_ones = [future for chunk in chunks for future in chunk.futures if not future.done()]
        wait(open_ones, return_when=FIRST_COMPLETED)
