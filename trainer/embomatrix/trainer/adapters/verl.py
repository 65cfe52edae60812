"""Adapter for verl: its custom reward function.

Set ``reward.custom_reward_function.path`` to this file and ``reward.custom_reward_function.name`` to ``compute_score``, as
verl 0.9.1 reads them. verl scores each sample as soon as it is generated, so simulation and generation overlap.
"""

from collections.abc import Mapping

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.trainer.adapters.rows import dataset_named
from embomatrix.trainer.adapters.scorer import reward_named, shared_scorer


async def compute_score(
    data_source: str,
    solution_str: str,
    ground_truth: str,
    extra_info: Mapping[str, object] | None = None,
    *,
    dataset: str = "",
    manager: str = "",
    token: str = "",
    ca: str = "",
    reward: str = "",
    **_: object,
) -> dict[str, float]:
    """Score one answer.

    ``ground_truth`` is the task's id; the keyword arguments are ``reward.custom_reward_function.reward_kwargs``, among them
    ``reward``, a text for ``reward_named``. verl has no mark for a missing reward, and NaN would spoil its step, so lost
    rollouts are repeated.
    """
    named = dataset_named(dataset, "custom_reward_function.reward_kwargs.dataset")
    scorer = shared_scorer(named, manager, token, ca, reward=reward_named(reward))
    return reward_payload(await scorer.reward_of(ground_truth, solution_str))


def reward_payload(reward: RewardBreakdown) -> dict[str, float]:
    """verl's format: the score and the values that it logs, always with the same keys."""
    return {"score": reward.total, **reward.tiers, "success": float(reward.success)}
