"""`embomatrix play --policy` with a policy that was trained in episodes: it plays, and a person reads along."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from embomatrix.trainer.policy.playing import rows_of_episodes

if TYPE_CHECKING:
    from embomatrix.envs.environment import Environment
    from embomatrix.envs.rules import EpisodeReward
    from embomatrix.trainer.policy.protocol import Policy


def play_by_policy(
    environment: Environment,
    policy: Policy,
    task_id: str,
    seed: int,
    show: Callable[[str], None],
    *,
    longest: int,
) -> EpisodeReward | None:
    """Play an episode with the most probable answers, and show all texts. Return its reward, None if no answer fits.

    ``longest``: maximum tokens of a language model's answer.
    """
    prompt = environment.reset(task_id, seed=seed)
    show(prompt.user)
    rows = rows_of_episodes(policy, [policy.encode(prompt)], 1, 0.0, seed, longest)
    reward = None
    while (answer := rows.answer([0])[0]) is not None:
        show(f"> {answer}")
        observation = environment.step(answer)
        show(observation.text)
        reward = observation.reward
        if observation.end is not None:
            break
        rows.observe([0], [observation.text])
    return reward
