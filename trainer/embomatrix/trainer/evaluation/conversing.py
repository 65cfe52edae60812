"""Policies that were trained in episodes, in the episodes of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.skills.parse import DONE
from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.evaluation.answer_sources import OnProgress, seed_of
from embomatrix.trainer.evaluation.episodes import EpisodeStage, Said, play_episodes

if TYPE_CHECKING:
    from embomatrix.envs.player import EpisodePlayer
    from embomatrix.trainer.evaluation.answers import AnswerSheet, EvaluationSetup
    from embomatrix.trainer.evaluation.exam import Question
    from embomatrix.trainer.policy.conversation import Conversation
    from embomatrix.trainer.policy.tiny import TinyPolicy

NO_ROOM: Final = "no room"
"""Answer of a policy whose context is full. It counts as a failed call."""


class ConversingSubject:
    """Policy that plays one episode. It reads each text once and keeps what it knows of it."""

    def __init__(self, policy: TinyPolicy, setup: EvaluationSetup, task_id: str, sample: int) -> None:
        self._policy = policy
        self._temperature = setup.temperature
        self._seed = seed_of(setup.seed, task_id, sample)
        self._conversation: Conversation | None = None

    async def answer(
        self, system: str, told: Sequence[str], said: Sequence[str], player: EpisodePlayer
    ) -> Said:
        """Return the next call, or that the task is done."""
        if self._conversation is None:
            self._conversation = self._begun(told[-1])
        else:
            self._conversation.tell([0], [told[-1]])
        answer = self._conversation.answer([0])[0]
        if answer is None:
            return Said(NO_ROOM)
        return Said(answer or DONE, completion_tokens=len(self._policy.encode_plan(answer)))

    def _begun(self, opening: str) -> Conversation:
        import torch

        from embomatrix.trainer.policy.conversation import Conversation

        generator = torch.Generator(self._policy.device).manual_seed(self._seed)
        prompt = self._policy.encode(Prompt("", opening))
        return Conversation(self._policy, [prompt], 1, self._temperature, generator)


def converse_in_episodes(
    policy: TinyPolicy,
    stage: EpisodeStage,
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Play episodes with a policy that was trained in them. Raises ClusterError and EngineError.

    Each episode has a seed of its own, so a resumed evaluation draws the same answers.
    """

    def subject_of(task_id: str, sample: int) -> ConversingSubject:
        return ConversingSubject(policy, sheet.setup, task_id, sample)

    play_episodes(stage, subject_of, questions, sheet, on_progress)
