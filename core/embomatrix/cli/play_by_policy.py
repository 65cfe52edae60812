"""`embomatrix play --policy` with a policy that was trained in episodes: it plays, and a person reads along."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from embomatrix.skills.parse import DONE
from embomatrix.trainer.policy.episode_rows import EpisodeRows

if TYPE_CHECKING:
    from embomatrix.envs.environment import Environment
    from embomatrix.envs.rules import EpisodeReward
    from embomatrix.trainer.policy.tiny import TinyPolicy


def play_by_policy(
    environment: Environment, policy: TinyPolicy, task_id: str, seed: int, show: Callable[[str], None]
) -> EpisodeReward | None:
    """Play an episode with the most probable answers, and show all texts. Return its reward, None if no answer fits."""
    prompt = environment.reset(task_id, seed=seed)
    show(prompt.user)
    rows = EpisodeRows(policy, [policy.encode(prompt)], 1, 0.0, torch.Generator().manual_seed(seed))
    reward = None
    while (answer := rows.answer([0])[0]) is not None:
        show(f"> {answer or DONE}")
        observation = environment.step(answer or DONE)
        show(observation.text)
        reward = observation.reward
        if observation.end is not None:
            break
        rows.tell([0], [observation.text])
    return reward
