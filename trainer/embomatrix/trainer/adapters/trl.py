"""Adapter for TRL's ``GRPOTrainer``: a reward function for whole plans, and a mixin that announces the tasks of coming steps.

TRL itself is not imported: the reward is a callable, and the mixin overrides one method of the trainer class.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from torch.utils.data import BatchSampler

from embomatrix.trainer.adapters.scorer import PlanScorer, scorer_for
from embomatrix.trainer.cluster.gateway import PlanOutcome
from embomatrix.trainer.data.lookahead import Lookahead


class ClusterReward:
    """Asynchronous reward function for ``reward_funcs``. The dataset needs the column ``task_id``.

    Lost plans get None, which TRL leaves out of the group's mean and deviation. Tiers are logged as metrics, outcomes beside
    the completions.
    """

    __name__ = "cluster"

    def __init__(self, scorer: PlanScorer) -> None:
        self.scorer = scorer

    @classmethod
    def at(cls, dataset: str | Path, manager: str = "", **options: Any) -> Self:
        """Create a reward on the cluster at this address; see ``scorer_for``."""
        return cls(scorer_for(dataset, manager, **options))

    def announce(self, steps: Sequence[Sequence[str]], group: int) -> None:
        """Announce the tasks of this step and the next ones to the cluster, with ``group`` plans each."""
        self.scorer.announce(steps, group)

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
        """Return one reward per completion: the sum of the three tiers. Raises TrainerError."""
        outcomes = await self.scorer.score(task_id, [text_of(completion) for completion in completions])
        if log_metric is not None:
            for name, value in tiers(outcomes).items():
                log_metric(f"embomatrix/{name}", value)
        if log_extra is not None:
            log_extra("task", list(task_id))
            log_extra("outcome", [outcome_summary(outcome) for outcome in outcomes])
        return [None if outcome.reward is None else outcome.reward.total for outcome in outcomes]


@runtime_checkable
class AnnouncedTo(Protocol):
    """Reward function whose cluster wants to know the tasks of coming steps: ``ClusterReward``, ``ClusterEpisodes``."""

    def announce(self, steps: Sequence[Sequence[str]], group: int) -> None: ...


class ClusterLookahead:
    """Mixin before ``GRPOTrainer``: announces the tasks of coming generations, so that the cluster loads their scenes.

    It uses the first reward function that is ``AnnouncedTo``, in the main process only.
    """

    lookahead_steps = 3

    def _get_train_sampler(self, *arguments: Any) -> Any:
        sampler = super()._get_train_sampler(*arguments)  # type: ignore[misc]  # of the trainer that this is mixed into
        trainer: Any = self
        rewards = [reward for reward in trainer.reward_funcs if isinstance(reward, AnnouncedTo)]
        if not rewards or not trainer.accelerator.is_main_process:
            return sampler
        repeats = trainer.num_generations * trainer.num_iterations * trainer.args.steps_per_generation
        prompts = trainer.args.generation_batch_size // trainer.num_generations
        dataset = arguments[0] if arguments and arguments[0] is not None else trainer.train_dataset
        task_ids = list(dataset["task_id"])

        def announce(steps: list[list[int]]) -> None:
            named = [[task_ids[index] for index in step] for step in steps]
            rewards[0].announce(named, trainer.num_generations)

        return AnnouncedSampler(sampler, prompts * repeats, self.lookahead_steps, announce)


class AnnouncedSampler:
    """Sampler that announces the current and the next portions before each portion.

    ``portion`` is the number of indices per generation, including repetitions. ``announce`` gets the distinct indices of each.
    """

    def __init__(
        self,
        sampler: Iterable[int],
        portion: int,
        steps: int,
        announce: Callable[[list[list[int]]], None],
    ) -> None:
        self._sampler = sampler
        self._portions = Lookahead(BatchSampler(sampler, portion, drop_last=False), steps=steps)
        self._announce = announce

    def __iter__(self) -> Iterator[int]:
        for portion in self._portions:
            self._announce([list(dict.fromkeys(each)) for each in self._portions.window()])
            yield from portion

    def __len__(self) -> int:
        return len(self._sampler)  # type: ignore[arg-type]  # TRL's sampler has a length


def text_of(completion: object) -> str:
    """Text of a completion: a string, or the last of several chat messages."""
    if isinstance(completion, str):
        return completion
    if isinstance(completion, (list, tuple)) and completion and isinstance(completion[-1], dict):
        return str(completion[-1].get("content") or "")
    return ""


def tiers(outcomes: Sequence[PlanOutcome]) -> dict[str, float]:
    """Means of the tiers and of success over known rewards, and the share of lost plans."""
    known = [outcome.reward for outcome in outcomes if outcome.reward is not None]
    means = {"lost": 1.0 - len(known) / len(outcomes)} if outcomes else {}
    if known:
        rows = [{**reward.tiers, "success": float(reward.success)} for reward in known]
        means |= {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return means


def outcome_summary(outcome: PlanOutcome) -> str:
    """Outcome of a plan in a few words: the parser's error, the last step's message, or that it was lost."""
    if outcome.problem:
        return outcome.problem
    if outcome.reward is None:
        return "lost to the infrastructure"
    return outcome.steps[-1].message if outcome.steps else "an empty plan"
