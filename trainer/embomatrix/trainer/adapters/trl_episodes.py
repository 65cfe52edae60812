"""Adapter for TRL's ``GRPOTrainer``: episodes on a cluster, by its ``environment_factory``.

The model calls skills as tools, and is told after each call what happened. TRL itself is not imported.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from embomatrix.envs.environment import Environment
from embomatrix.envs.rules import EpisodeRules, rules_of
from embomatrix.envs.simulation import ClusterSimulation
from embomatrix.envs.tools import HouseholdTools, PaperTools, system_text
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.cluster_address import cluster_named
from embomatrix.rpc.episodes import TurnFailedError
from embomatrix.rpc.status import ClusterError
from embomatrix.skills.prompt import Codec
from embomatrix.skills.seeds import split_seed
from embomatrix.skills.syntax import Skill
from embomatrix.skills.turns import PrefixMismatchError
from embomatrix.starter.shipped import dataset_named
from embomatrix.trainer.adapters.scorer import reward_named
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.dataset import DatasetError
from embomatrix.world.task import Profile

LOST: Final = "The simulation failed, and the episode is over: answer without a call."


class ErrorKeeping(PaperTools):
    """Tools that keep the cluster's errors for the reward function: TRL would tell them to the model, and go on."""

    lost = False
    """True if the episode has no result, which is not the model's fault."""
    error: ClusterError | None = None
    """Error that other episodes will meet too."""

    def reset(self, task_id: str, seed: int = 0, **_: object) -> str:
        """Begin an episode of a task, and return the text that opens it. Raises DatasetError for an unknown task."""
        self.lost, self.error = False, None
        return self._kept(lambda: super(ErrorKeeping, self).reset(task_id, seed))

    def _call(self, skill: Skill, **arguments: object) -> str:
        if self.lost:
            return LOST
        return self._kept(lambda: super(ErrorKeeping, self)._call(skill, **arguments))

    def _kept(self, act: Callable[[], str]) -> str:
        try:
            return act()
        except PrefixMismatchError:
            self.lost = True
        except ClusterError as error:
            self.lost = True
            self.error = None if isinstance(error, TurnFailedError) else error
        return LOST


class PaperEpisode(ErrorKeeping):
    """Tools of the profile ``paper``."""


class HouseholdEpisode(ErrorKeeping, HouseholdTools):
    """Tools of the profile ``household``."""


class ClusterEpisodes:
    """Episodes of a dataset's tasks: ``rows`` for the dataset, ``factories`` for ``environment_factory``, and itself a reward.

    All episodes of a task share a seed, so equal calls have equal outcomes. Lost episodes get None, which TRL leaves out of
    the group's mean and deviation.
    """

    __name__ = "cluster"

    def __init__(self, environment: Environment, seed: int = 0) -> None:
        self.environment = environment
        self._seed = seed

    @classmethod
    def at(
        cls,
        dataset: str | Path,
        manager: str = "",
        token: str = "",
        ca: str | Path = "",
        *,
        visibility: str | None = None,
        rules: EpisodeRules | None = None,
        reward: RewardSettings | None = None,
        seed: int = 0,
    ) -> Self:
        """Open episodes on a cluster. Raises TrainerError, and ValueError for an unknown visibility.

        The cluster is named as in ``cluster_named``, the reward's coefficients as in ``scorer_for``; dataset, visibility and
        rules are those of ``envs.make``.
        """
        known = rules_of(rules, visibility)
        try:
            data = dataset_named(dataset)
            named = cluster_named(manager, token, ca)
            connect = functools.partial(ClusterClient, named.manager, named.token, ca=named.ca)
            simulation = ClusterSimulation(data, connect, reward_named() if reward is None else reward)
            environment = Environment(data, "train", known, Codec.LINES, simulation, seed)
        except (ClusterError, DatasetError) as error:
            raise TrainerError(str(error)) from error
        return cls(environment, seed)

    def rows(self, split: str = "train") -> list[dict[str, Any]]:
        """One row for each task of a split: the system text, and the columns by which an environment begins its episode.

        TRL adds what the robot knows at the start, which ``reset`` returns, to the empty message of the user.
        """
        return [
            {
                "prompt": [
                    {"role": "system", "content": system_text(self.environment, record.task.profile)},
                    {"role": "user", "content": ""},
                ],
                "task_id": record.task.task_id,
                "seed": split_seed(split, self._seed, record.task.task_id),
                "environment": record.task.profile.value,
            }
            for record in self.environment.dataset.records
            if record.split == split
        ]

    @property
    def factories(self) -> Mapping[str, Callable[[], ErrorKeeping]]:
        """Environments by the column ``environment``: each shows the model the skills of one profile."""
        return {
            Profile.PAPER.value: functools.partial(PaperEpisode, self.environment),
            Profile.HOUSEHOLD.value: functools.partial(HouseholdEpisode, self.environment),
        }

    def announce(self, steps: Sequence[Sequence[str]], group: int) -> None:
        """Announce the tasks of this step and the next ones to the cluster, with ``group`` episodes each."""
        self.environment.announce(steps, group)

    def __call__(
        self,
        prompts: Sequence[object],
        completions: Sequence[object],
        *,
        environments: Sequence[ErrorKeeping],
        log_metric: Callable[[str, float], None] | None = None,
        log_extra: Callable[[str, list[Any]], None] | None = None,
        **_: object,
    ) -> list[float | None]:
        """Return one reward for each episode: the tiers of the state reached, less the costs of its calls.

        Raises TrainerError for an error of the cluster that other episodes will meet too.
        """
        for tools in environments:
            if tools.error is not None:
                raise TrainerError(str(tools.error)) from tools.error
        if log_metric is not None:
            for name, value in means(environments).items():
                log_metric(f"embomatrix/{name}", value)
        if log_extra is not None:
            log_extra("task", ["" if tools.lost else tools.episode.task_id for tools in environments])
            log_extra("outcome", [last_message(tools) for tools in environments])
        return [None if tools.lost else tools.episode.player.reward.total for tools in environments]

    def close(self) -> None:
        """End the run at the manager."""
        self.environment.close()


def means(environments: Sequence[ErrorKeeping]) -> dict[str, float]:
    """Means of the tiers, success and calls over the episodes with a result, and the share of lost ones."""
    rewards = [tools.episode.player.reward for tools in environments if not tools.lost]
    found = {"lost": 1.0 - len(rewards) / len(environments)} if environments else {}
    if rewards:
        rows = [
            {
                **reward.tiers.tiers,
                "success": float(reward.tiers.success),
                "calls": float(reward.calls),
                "failed_calls": float(reward.failures),
            }
            for reward in rewards
        ]
        found |= {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return found


def last_message(tools: ErrorKeeping) -> str:
    """Outcome of an episode in a few words: that of its last call."""
    if tools.lost:
        return "lost to the infrastructure"
    steps = tools.episode.player.steps
    return steps[-1].message if steps else "no call"
