"""A taskset for ``verifiers`` (its v1 interface), and so for prime-rl: prompts of a dataset, rewards of a cluster.

Its commands find a taskset by a module of one word, such as `docs/examples/embomatrix_household.py`; the cluster comes from
the environment.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import verifiers.v1 as vf

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.adapters.rows import tasks_of
from embomatrix.trainer.adapters.scorer import given_up, scorer_for

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.trainer.adapters.scorer import PlanScorer

__all__ = ["HouseholdTaskset"]
UNNAMED = "name the dataset's folder with --env.taskset.dataset"


class HouseholdConfig(vf.TasksetConfig):  # type: ignore[misc]  # untyped where it is not installed
    """``dataset``: a dataset's folder; ``split``: train or heldout."""

    dataset: str = ""
    split: str = "train"


class HouseholdData(vf.TaskData):  # type: ignore[misc]
    """``dataset`` travels with each task, so that whoever scores it finds its scene."""

    dataset: str
    category: str


class HouseholdTask(vf.Task[HouseholdData, vf.State, vf.TaskConfig]):  # type: ignore[misc]
    """One answer, one plan. What the infrastructure lost is an error of the rollout, never a number."""

    @vf.reward  # type: ignore[untyped-decorator]
    async def tiers(self, trace: vf.Trace) -> dict[str, float]:
        """The three tiers, which add up to the reward; success is a metric beside them."""
        task_id = str(self.data.id)
        outcome = await _scorer(self.data.dataset).score_one(task_id, trace.last_reply)
        if outcome.reward is None:
            raise given_up(task_id)
        trace.record_metrics({"success": float(outcome.success)})
        reward = outcome.reward
        return {"format": reward.format, "relevance": reward.relevance, "goal": reward.goal}


class HouseholdTaskset(vf.Taskset[HouseholdTask, HouseholdConfig]):  # type: ignore[misc]
    """The tasks of one split."""

    def load(self) -> Iterator[HouseholdTask]:
        """Raises TrainerError where the dataset can't be read, ValueError where none is named."""
        if not self.config.dataset:
            raise ValueError(UNNAMED)
        for task in tasks_of(self.config.dataset, self.config.split):
            prompt = prompt_for(task.situation, Codec.JSON)
            data = HouseholdData(
                id=task.task.task_id,
                prompt=prompt.user,
                system_prompt=prompt.system,
                dataset=self.config.dataset,
                category=task.task.category.value,
            )
            yield HouseholdTask(data, self.config.task)


@functools.cache
def _scorer(dataset: str) -> PlanScorer:
    return scorer_for(dataset)
