"""Adapter for OpenRLHF, which can ask for rewards in two ways.

``--reward.remote_url http://MANAGER:PORT/api/v1/rewards`` asks the manager, which needs the bundles first
(``give_bundles``). ``--reward.remote_url THIS_FILE`` calls ``reward_func`` in OpenRLHF's own process.
"""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.reward_label import RewardLabel, answer_in
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.skills.seeds import split_seed
from embomatrix.trainer.adapters.rows import dataset_named, messages, tasks_of
from embomatrix.trainer.adapters.scorer import PlanScorer, shared_scorer
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import load_tasks


def rows(dataset: str | Path, split: str = "train", seed: int = 0) -> list[dict[str, Any]]:
    """``{"input": messages, "label": text}`` for each task of a split: ``--data.input_key input --data.label_key label``."""
    return [
        {
            "input": messages(task.situation),
            "label": RewardLabel(
                task.task.task_id,
                task.bundle_digest,
                task.task.profile,
                split_seed(split, seed, task.task.task_id),
            ).text(),
        }
        for task in tasks_of(dataset, split)
    ]


async def give_bundles(dataset: str | Path, client: ClusterClient) -> int:
    """Upload the scenes that the manager lacks, and return their number. Raises ClusterError."""
    tasks = load_tasks(Path(dataset))
    digests = {task.bundle_digest for task in (*tasks.train, *tasks.heldout)}
    sent = 0
    for digest in sorted(digests):
        sent += len(await client.put_bundles({digest: tasks.bundle_bytes(digest)}))
    return sent


def reward_func(queries: Sequence[str], prompts: Sequence[str], labels: Sequence[str]) -> dict[str, Any]:
    """OpenRLHF's hook. Dataset and cluster come from the environment, tasks and seeds from the labels. Raises TrainerError."""
    try:
        answers = [answer_in(query, prompt) for query, prompt in zip(queries, prompts, strict=True)]
        asked = [RewardLabel.parse(label) for label in labels]
    except InvalidRequestError as error:
        raise TrainerError(str(error)) from error
    scorer = shared_scorer(dataset_named("", ""))
    return reward_payload(asyncio.run(rewards_of(scorer, asked, answers)))


async def rewards_of(
    scorer: PlanScorer, labels: Sequence[RewardLabel], answers: Sequence[str]
) -> list[RewardBreakdown]:
    """Return the reward of each answer to the task of its label, under the label's seed. Lost rollouts are repeated."""
    pairs = zip(labels, answers, strict=True)
    return await asyncio.gather(
        *(scorer.reward_of(label.task_id, answer, label.seed) for label, answer in pairs)
    )


def reward_payload(rewards: Sequence[RewardBreakdown]) -> dict[str, Any]:
    """OpenRLHF's format: rewards, scores in [0, 1] for its filter, and extra logs."""
    return {
        "rewards": torch.tensor([reward.total for reward in rewards]),
        "scores": torch.tensor([float(reward.success) for reward in rewards]),
        "extra_logs": {
            name: torch.tensor([reward.tiers[name] for reward in rewards])
            for name in ("format", "relevance", "goal")
        },
    }
