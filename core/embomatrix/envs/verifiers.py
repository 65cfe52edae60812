"""Adapter for ``verifiers`` (its v1 interface), and so for prime-rl: tasks that are played as episodes, call by call.

Commands of verifiers load both classes from a single-word module such as `docs/examples/embomatrix_episodes.py`. Episodes run
in the process of verifiers' environment, or on the cluster that ``EMBOMATRIX_MANAGER`` names.
"""

from collections.abc import Iterator

try:
    import verifiers.v1 as vf
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.envs.verifiers needs the package {error.name}: pip install 'verifiers>=0.4'",
        name=error.name,
    ) from None

from embomatrix.envs.rules import EpisodeRules, Visibility, rules_of
from embomatrix.envs.shared import in_thread, shared_environment
from embomatrix.skills.episode_text import system_for_answers
from embomatrix.skills.prompt import Codec
from embomatrix.skills.seeds import split_seed
from embomatrix.skills.syntax import MAX_STEPS
from embomatrix.starter.shipped import SEARCH

__all__ = ["EpisodesEnv", "EpisodesTaskset"]


class EpisodesConfig(vf.TasksetConfig):
    """Tasks and rules.

    ``dataset``: ``starter``, ``search`` or a folder; ``split``: train or heldout; ``visibility``: full or seen; ``calls``:
    budget of an episode; ``seed``: that of the simulation, drawn anew for each task.
    """

    dataset: str = SEARCH
    split: str = "train"
    visibility: str = Visibility.SEEN.value
    calls: int = MAX_STEPS
    seed: int = 0


class EpisodesData(vf.TaskData):
    """Settings are stored with each task, so that any process can play it. ``simulation_seed`` is that of its episodes."""

    dataset: str
    split: str
    visibility: str
    calls: int
    simulation_seed: int
    category: str


class EpisodesTask(vf.Task[EpisodesData, vf.State, vf.TaskConfig]):
    """Task that is played as an episode."""


class EpisodesTaskset(vf.Taskset[EpisodesTask, EpisodesConfig]):
    """Tasks of one split."""

    def load(self) -> Iterator[EpisodesTask]:
        """Raises ValueError for wrong rules, and DatasetError for a missing dataset."""
        config = self.config
        rules = rules_of(EpisodeRules(calls=config.calls), config.visibility)
        for record in shared_environment(
            config.dataset, config.split, config.visibility, config.calls
        ).records:
            task = record.task
            data = EpisodesData(
                id=task.task_id,
                system_prompt=system_for_answers(
                    Codec.LINES,
                    task.profile,
                    seen=rules.visibility is Visibility.SEEN,
                    at_once=rules.calls_per_answer,
                ),
                dataset=config.dataset,
                split=config.split,
                visibility=config.visibility,
                calls=config.calls,
                simulation_seed=split_seed(config.split, config.seed, task.task_id),
                category=task.category.value,
            )
            yield EpisodesTask(data, config.task)


class EpisodesEnvConfig(vf.EnvConfig):
    """``agent`` is the model that plays."""

    agent: vf.AgentConfig = vf.AgentConfig()


class EpisodesEnv(vf.Env[EpisodesEnvConfig]):
    """Plays an episode: what the robot observes is what a user would say, and an answer is one call, or ``done``.

    An episode whose turn has no result is an error of the rollout, never a number.
    """

    async def run(self, task: EpisodesTask, agents: vf.Agents) -> None:
        data = task.data
        environment = await in_thread(
            shared_environment, data.dataset, data.split, data.visibility, data.calls
        )
        (episode,) = await in_thread(environment.begin, [(str(data.id), data.simulation_seed)])
        async with agents.agent.interaction(task) as interaction:
            segment = await interaction.turn(episode.prompt.user)
            while not segment.terminated:
                (observation,) = await in_thread(environment.answer, [episode], [segment.last_reply])
                if observation.end is not None:
                    break
                segment = await interaction.turn(observation.text)
        reward, trace = episode.player.reward, interaction.trace
        for tier, value in reward.tiers.tiers.items():
            trace.record_reward(tier, value)
        trace.record_metrics(reward.metrics)
