"""Policies that were trained in episodes, in the episodes of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.evaluation.answer_sources import OnProgress, seed_of
from embomatrix.trainer.evaluation.episodes import AgentReply, EpisodeRunner, play_episodes

if TYPE_CHECKING:
    from embomatrix.envs.player import EpisodePlayer
    from embomatrix.trainer.evaluation.answers import AnswerSheet, EvaluationSetup
    from embomatrix.trainer.evaluation.exam import Question
    from embomatrix.trainer.policy.chat_rows import ChatRows
    from embomatrix.trainer.policy.episode_rows import EpisodeRows
    from embomatrix.trainer.policy.protocol import Policy


CONCURRENT: Final = 16
"""Episodes that a policy plays at a time: enough to answer in one while the others are executed. Each has a cache."""


class PolicyAgent:
    """Policy that plays one episode. It keeps its key-value cache between two answers."""

    def __init__(self, policy: Policy, setup: EvaluationSetup, task_id: str, sample: int) -> None:
        self._policy = policy
        self._temperature = setup.temperature
        self._longest = setup.max_tokens
        self._seed = seed_of(setup.seed, task_id, sample)
        self._episode: EpisodeRows | ChatRows | None = None

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Return the next call, or that the task is done."""
        if self._episode is None:
            self._episode = self._begun(Prompt(system, observations[-1]))
        else:
            self._episode.observe([0], [observations[-1]])
        answer = self._episode.answer([0])[0]
        if answer is None:
            player.stop()
            return AgentReply("")
        return AgentReply(answer, completion_tokens=len(self._policy.encode_answer(answer)))

    def _begun(self, opening: Prompt) -> EpisodeRows | ChatRows:
        from embomatrix.trainer.policy.playing import rows_of_episodes

        prompt = self._policy.encode(opening)
        return rows_of_episodes(self._policy, [prompt], 1, self._temperature, self._seed, self._longest)


def converse_in_episodes(
    policy: Policy,
    stage: EpisodeRunner,
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Play episodes with a policy that was trained in them. Raises ClusterError and EngineError.

    Each episode has a seed of its own, so a resumed evaluation draws the same answers.
    """

    def agent_of(task_id: str, sample: int) -> PolicyAgent:
        return PolicyAgent(policy, sheet.setup, task_id, sample)

    play_episodes(stage, agent_of, questions, sheet, on_progress, concurrent=CONCURRENT)
