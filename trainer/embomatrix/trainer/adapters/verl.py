"""verl's custom reward function: ``custom_reward_function.path`` names this file, ``.name`` is ``compute_score``.

verl scores each sample as soon as it is generated, so that simulation and generation overlap without further ado.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from embomatrix.trainer.adapters.scorer import ATTEMPTS, given_up, scorer_for

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.trainer.adapters.scorer import PlanScorer


@functools.cache
def scorer_of(dataset: str, manager: str, token: str, ca: str) -> PlanScorer:
    """One scorer for each cluster and process."""
    return scorer_for(dataset, manager, token, ca)


async def compute_score(
    data_source: str,
    solution_str: str,
    ground_truth: str,
    extra_info: Mapping[str, object] | None = None,
    *,
    dataset: str,
    manager: str = "",
    token: str = "",
    ca: str = "",
    **_: object,
) -> dict[str, float]:
    """The reward of one answer; ``ground_truth`` is the task's id. The rest are ``custom_reward_function.reward_kwargs``."""
    return await scored(scorer_of(dataset, manager, token, ca), ground_truth, solution_str)


async def scored(scorer: PlanScorer, task_id: str, text: str) -> dict[str, float]:
    """The tiers of one answer.

    verl has no mark for an answer without a reward, and NaN would spoil its step: what the infrastructure lost is executed
    again, and given up with TrainerError after ``ATTEMPTS``.
    """
    for _attempt in range(ATTEMPTS):
        outcome = await scorer.score_one(task_id, text)
        if outcome.reward is not None:
            return told(outcome.reward)
    raise given_up(task_id)


def told(reward: RewardBreakdown) -> dict[str, float]:
    """The score with what verl logs beside it: always the same keys."""
    return {
        "score": reward.total,
        "format": reward.format,
        "relevance": reward.relevance,
        "goal": reward.goal,
        "success": float(reward.success),
    }
