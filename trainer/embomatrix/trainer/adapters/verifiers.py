"""Adapter for ``verifiers`` (its v1 interface), and so for prime-rl: a taskset that scores plans on a cluster.

Commands of verifiers load a taskset from a single-word module such as `docs/examples/embomatrix_household.py`. The
environment configures the cluster.
"""

from collections.abc import Iterator

try:
    import verifiers.v1 as vf
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.trainer.adapters.verifiers needs the package {error.name}: pip install 'verifiers>=0.4'",
        name=error.name,
    ) from None

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.adapters.rows import dataset_named, tasks_of
from embomatrix.trainer.adapters.scorer import reward_named, shared_scorer

__all__ = ["HouseholdTaskset"]


class HouseholdConfig(vf.TasksetConfig):
    """``dataset``: folder of a dataset, by default that of ``EMBOMATRIX_DATASET``; ``split``: train or heldout.

    ``reward``: coefficients of the reward, a text for ``reward_named``.
    """

    dataset: str = ""
    split: str = "train"
    reward: str = ""


class HouseholdData(vf.TaskData):
    """``dataset`` and ``reward`` are stored with each task, so that any process can find its scene and score it."""

    dataset: str
    reward: str
    category: str


class HouseholdTask(vf.Task[HouseholdData, vf.State, vf.TaskConfig]):
    """Task with one plan as its answer. A rollout that is lost repeatedly is an error of the rollout, never a number."""

    @vf.reward
    async def tiers(self, trace: vf.Trace) -> dict[str, float]:
        """Return the three tiers, which add up to the reward. Success is a separate metric."""
        scorer = shared_scorer(self.data.dataset, reward=reward_named(self.data.reward))
        reward = await scorer.reward_of(str(self.data.id), trace.last_reply)
        trace.record_metrics({"success": float(reward.success)})
        return reward.tiers


class HouseholdTaskset(vf.Taskset[HouseholdTask, HouseholdConfig]):
    """Tasks of one split."""

    def load(self) -> Iterator[HouseholdTask]:
        """Raises TrainerError if no dataset is named, if it can't be read, and for wrong coefficients."""
        reward_named(self.config.reward)
        dataset = dataset_named(self.config.dataset, "--env.taskset.dataset")
        for task in tasks_of(dataset, self.config.split):
            prompt = prompt_for(task.situation, Codec.JSON)
            data = HouseholdData(
                id=task.task.task_id,
                prompt=prompt.user,
                system_prompt=prompt.system,
                dataset=dataset,
                reward=self.config.reward,
                category=task.task.category.value,
            )
            yield HouseholdTask(data, self.config.task)
