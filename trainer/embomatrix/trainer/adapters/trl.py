"""TRL's ``GRPOTrainer`` on our cluster: a reward function, and a mixin that announces the tasks of coming steps.

Nothing of TRL is imported here: the reward is a callable, the mixin overrides one method of the class that it is mixed into.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from embomatrix.trainer.adapters.scorer import scorer_for
from embomatrix.trainer.data.lookahead import Lookahead

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path
    from typing import Self

    from embomatrix.trainer.adapters.scorer import PlanScorer
    from embomatrix.trainer.cluster.gateway import PlanOutcome


class ClusterReward:
    """An asynchronous reward function for ``reward_funcs``. The dataset's rows need the column ``task_id``.

    A plan that the infrastructure lost is None, which TRL leaves out of its group's mean and spread. The tiers are logged as
    metrics, causes and rewards beside the completions.
    """

    __name__ = "cluster"

    def __init__(self, scorer: PlanScorer) -> None:
        self.scorer = scorer

    @classmethod
    def at(cls, dataset: str | Path, manager: str = "", **options: Any) -> Self:
        """On the cluster of this address, as ``scorer_for``."""
        return cls(scorer_for(dataset, manager, **options))

    async def __call__(
        self,
        prompts: Sequence[object],
        completions: Sequence[object],
        *,
        task_id: Sequence[str],
        log_metric: Callable[[str, float], None] | None = None,
        log_extra: Callable[[str, list[Any]], None] | None = None,
        **_: object,
    ) -> list[float | None]:
        """One reward for each completion: the sum of the three tiers. Raises TrainerError."""
        outcomes = await self.scorer.score(task_id, [text_of(completion) for completion in completions])
        if log_metric is not None:
            for name, value in tiers(outcomes).items():
                log_metric(f"embomatrix/{name}", value)
        if log_extra is not None:
            log_extra("task", list(task_id))
            log_extra("became", [became(outcome) for outcome in outcomes])
        return [None if outcome.reward is None else outcome.reward.total for outcome in outcomes]


class ClusterLookahead:
    """Mixin before ``GRPOTrainer``: the cluster hears which tasks the coming generations need, and loads their scenes.

    It speaks for the first ``ClusterReward`` among the reward functions, in the main process alone.
    """

    lookahead_steps = 3

    def _get_train_sampler(self, *arguments: Any) -> Any:
        sampler = super()._get_train_sampler(*arguments)  # type: ignore[misc]  # of the trainer that this is mixed into
        trainer: Any = self
        rewards = [reward for reward in trainer.reward_funcs if isinstance(reward, ClusterReward)]
        if not rewards or not trainer.accelerator.is_main_process:
            return sampler
        repeats = trainer.num_generations * trainer.num_iterations * trainer.args.steps_per_generation
        prompts = trainer.args.generation_batch_size // trainer.num_generations
        dataset = arguments[0] if arguments and arguments[0] is not None else trainer.train_dataset
        task_ids = list(dataset["task_id"])

        def announce(steps: list[list[int]]) -> None:
            named = [[task_ids[index] for index in step] for step in steps]
            rewards[0].scorer.announce(named, trainer.num_generations)

        return AnnouncedSampler(sampler, prompts * repeats, self.lookahead_steps, announce)


class AnnouncedSampler:
    """Gives the indices of a sampler in their order; before each portion it tells what this and the next ones hold.

    ``portion`` is how many indices one generation takes, repetitions included; ``announce`` gets the distinct ones of each.
    """

    def __init__(
        self,
        sampler: Iterable[int],
        portion: int,
        steps: int,
        announce: Callable[[list[list[int]]], None],
    ) -> None:
        self._sampler = sampler
        self._portions = Lookahead(_Portions(sampler, portion), steps=steps)
        self._announce = announce

    def __iter__(self) -> Iterator[int]:
        for portion in self._portions:
            self._announce([list(dict.fromkeys(each)) for each in self._portions.window()])
            yield from portion

    def __len__(self) -> int:
        return len(self._sampler)  # type: ignore[arg-type]  # TRL's sampler has a length


class _Portions:
    """A sampler's indices in portions, anew in each epoch."""

    def __init__(self, sampler: Iterable[int], size: int) -> None:
        self._sampler = sampler
        self._size = size

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        indices = iter(self._sampler)
        while portion := tuple(itertools.islice(indices, self._size)):
            yield portion


def text_of(completion: object) -> str:
    """The text of a completion: a string, or chat messages of which the last is the answer."""
    if isinstance(completion, str):
        return completion
    if isinstance(completion, (list, tuple)) and completion and isinstance(completion[-1], dict):
        return str(completion[-1].get("content") or "")
    return ""


def tiers(outcomes: Sequence[PlanOutcome]) -> dict[str, float]:
    """Means of the tiers and of success over the plans that have a reward, and the share of lost ones."""
    known = [outcome.reward for outcome in outcomes if outcome.reward is not None]
    told = {"lost": 1.0 - len(known) / len(outcomes)} if outcomes else {}
    if known:
        told |= {
            "format": float(np.mean([reward.format for reward in known])),
            "relevance": float(np.mean([reward.relevance for reward in known])),
            "goal": float(np.mean([reward.goal for reward in known])),
            "success": float(np.mean([reward.success for reward in known])),
        }
    return told


def became(outcome: PlanOutcome) -> str:
    """What became of a plan, in a few words: why it is none, its last step, or that it was lost."""
    if outcome.problem:
        return outcome.problem
    if outcome.reward is None:
        return "lost by the infrastructure"
    steps = getattr(outcome.outcome, "steps", ())
    return steps[-1].message if steps else "an empty plan"
