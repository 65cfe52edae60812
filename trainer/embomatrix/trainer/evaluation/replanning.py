"""Policies that write whole plans, in episodes.

Such a policy writes a plan from what it knows, and the plan is carried out call by call. After a failed call, and when the
robot has seen something new, the policy writes another plan from what it knows then.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.skills.parse import DONE, PlanError, plan_to_lines
from embomatrix.skills.prompt import limited, prompt_for
from embomatrix.trainer.cluster.gateway import parse_policy_text
from embomatrix.trainer.evaluation.answer_sources import OnProgress, seed_of
from embomatrix.trainer.evaluation.episodes import AgentReply, EpisodeRunner, play_episodes

if TYPE_CHECKING:
    from embomatrix.envs.player import EpisodePlayer
    from embomatrix.skills.prompt import Situation
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.trainer.evaluation.answers import AnswerSheet, EvaluationSetup
    from embomatrix.trainer.evaluation.exam import Question
    from embomatrix.trainer.policy.protocol import Policy

NO_PLAN: Final = "no plan"
"""Answer of a policy whose text holds no plan. It counts as a failed call."""


@dataclass(frozen=True, slots=True)
class WrittenPlan:
    """Plan of a policy, None if its text holds none, and the number of tokens of the text."""

    plan: Plan | None
    tokens: int


WritePlan = Callable[["Situation", int], WrittenPlan]
"""Writes a plan for a situation, as the n-th plan of an episode."""


class ReplanningAgent:
    """Policy that plays one episode by whole plans. Says that it has done when a plan is carried out."""

    def __init__(self, write: WritePlan) -> None:
        self._write = write
        self._calls: deque[SkillCall] = deque()
        self._known = -1
        self._plans = 0

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Return the next call of the plan, or of a new one."""
        situation = player.observer.situation
        failed = bool(player.steps) and not player.steps[-1].ok
        tokens = 0
        if failed or len(situation.rows) != self._known:
            written = self._write(situation, self._plans)
            self._plans += 1
            tokens = written.tokens
            # After a text without a plan the next answer is a new plan, whatever the robot knows by then.
            self._known = -1 if written.plan is None else len(situation.rows)
            self._calls = deque(written.plan or ())
            if written.plan is None:
                return AgentReply(NO_PLAN, completion_tokens=tokens)
        text = plan_to_lines((self._calls.popleft(),)) if self._calls else DONE
        return AgentReply(text, completion_tokens=tokens)


def ask_policy_in_episodes(
    policy: Policy,
    rows: int,
    stage: EpisodeRunner,
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Play episodes with a policy in this process, which is told at most ``rows`` rows.

    Raises ClusterError and EngineError. Each plan has a seed of its own, so a resumed evaluation draws the same plans.
    """
    setup = sheet.setup

    def agent_of(task_id: str, sample: int) -> ReplanningAgent:
        return ReplanningAgent(functools.partial(_written, policy, rows, setup, f"{task_id}:{sample}"))

    play_episodes(stage, agent_of, questions, sheet, on_progress)


def _written(
    policy: Policy, rows: int, setup: EvaluationSetup, episode: str, situation: Situation, number: int
) -> WrittenPlan:
    import torch

    asked = limited(situation, rows)
    device = next(iter(policy.parameters())).device
    drawn = policy.sample(
        [policy.encode(prompt_for(asked, policy.codec))],
        1,
        setup.temperature,
        setup.max_tokens,
        torch.Generator(device).manual_seed(seed_of(setup.seed, episode, number)),
    )
    tokens = int(drawn.mask.sum())
    try:
        return WrittenPlan(parse_policy_text(drawn.texts[0], asked, policy.codec), tokens)
    except PlanError:
        return WrittenPlan(None, tokens)
