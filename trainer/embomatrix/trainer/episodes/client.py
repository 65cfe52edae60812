"""Episodes of a training run on the cluster: answers in, observations out, while the trainer computes."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Hashable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from embomatrix.envs.player import EpisodePlayer
from embomatrix.envs.rules import EpisodeEnd
from embomatrix.rpc.episodes import TurnFailedError
from embomatrix.rpc.status import DeadlineError
from embomatrix.rpc.wire.values import InfraCode, InfraFailure
from embomatrix.skills.prompt import Codec, Prompt
from embomatrix.skills.syntax import MAX_STEPS
from embomatrix.skills.turns import PrefixMismatchError
from embomatrix.trainer.cluster.gateway import Gateway, PlanOutcome, PlayedTurn, Transcript
from embomatrix.trainer.episodes.terms import EpisodeTerms

if TYPE_CHECKING:
    from embomatrix.skills.turns import Advice
    from embomatrix.trainer.data.tasks import TrainingTask

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PlannedEpisode:
    """Episode of a task that shall be played, and the seed of its simulation.

    If ``handover`` is given, the policy gives at most so many answers, and then another takes over. The budget of calls is
    larger by as many, and equal failures do not end the episode.
    """

    task: TrainingTask
    seed: int
    handover: int | None = None


class ClusterEpisode:
    """One episode on the cluster. ``opening`` is its first text, None if the infrastructure lost the episode before."""

    def __init__(self, player: EpisodePlayer, handover: int | None = None) -> None:
        self.player = player
        self.opening: Prompt | None = None
        self.answers: list[str] = []
        """Answers so far."""
        self.turns: list[PlayedTurn] = []
        """Answers that got an observation."""
        self.states: list[Hashable] = []
        """State before each answer."""
        self.rewards_before: list[float] = []
        """Reward before each answer."""
        self.policy_answers = 0
        """Answers of the policy before another took over."""
        self.lost: InfraFailure | None = None
        self._handover = handover

    @property
    def is_over(self) -> bool:
        """True if the episode takes no further answer."""
        return self.lost is not None or self.player.end is not None

    @property
    def is_for_policy(self) -> bool:
        """True if the policy shall give the next answer."""
        return not self.is_over and (self._handover is None or len(self.answers) < self._handover)

    def hand_over(self) -> None:
        """Let another give the next answer, because the policy would end the episode."""
        self._handover = len(self.answers)

    @property
    def has_handover(self) -> bool:
        """True if another than the policy will finish the episode."""
        return self._handover is not None

    def stop(self) -> None:
        """End the episode because the policy has no room for another answer."""
        self.player.stop(EpisodeEnd.TOKENS)

    async def begin(self) -> None:
        """Fetch the opening. Raises ClusterError if the manager can't be reached."""
        self.opening = await self._try(self.player.begin)

    async def answer(self, text: str) -> str:
        """Take an answer and return the observation. Raises ClusterError if the manager can't be reached."""
        self.answers.append(text)
        self.states.append(self.player.state)
        self.rewards_before.append(self.player.reward.total)
        observation = await self._try(lambda: self.player.answer(text))
        if observation is None:
            return ""
        self.turns.append(PlayedTurn(text, observation.text, len(observation.steps)))
        return observation.text

    async def advise(self) -> Advice | None:
        """Ask the oracle what it would do from here on; None if the infrastructure lost the episode. Raises ClusterError."""
        return await self._try(self.player.advise)

    async def _try(self, work: Callable[[], Awaitable[T]]) -> T | None:
        """Return the result of a turn. Without one the episode is lost, which says nothing about the policy."""
        try:
            return await work()
        except TurnFailedError as error:
            self.lost = error.failure or InfraFailure(InfraCode.WORKER_LOST, str(error))
        except PrefixMismatchError as error:
            self.lost = InfraFailure(InfraCode.PREFIX_MISMATCH, str(error))
        except DeadlineError as error:
            self.lost = InfraFailure(InfraCode.DEADLINE, str(error))
        return None

    def outcome(self) -> PlanOutcome:
        """Return the outcome of the episode, with its answers as text, one a line."""
        text = "\n".join(self.answers)
        steps = tuple(self.player.steps)
        transcript = Transcript(
            "" if self.opening is None else self.opening.user, tuple(self.turns), self.player.end or ""
        )
        if self.lost is not None:
            return PlanOutcome(text, None, self.lost, transcript=transcript)
        reward, problem = self.player.reward, "" if steps else "the episode has no call"
        return PlanOutcome(
            text, reward.tiers, problem=problem, cost=reward.cost, played=steps, transcript=transcript
        )


class EpisodeClient:
    """Plays episodes in the run of a gateway. Call its methods from any thread, unless they say otherwise."""

    def __init__(self, gateway: Gateway, terms: EpisodeTerms, codec: Codec) -> None:
        self._gateway = gateway
        self._terms = terms
        self._codec = codec

    def begin(self, planned: Sequence[PlannedEpisode]) -> Future[list[ClusterEpisode]]:
        """Begin episodes. The future fails with ClusterError if the manager can't be reached."""
        return self._gateway.run(self.begin_all(planned))

    def run(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        """Start work that plays episodes, on the gateway's thread."""
        return self._gateway.run(work)

    async def begin_all(self, planned: Sequence[PlannedEpisode]) -> list[ClusterEpisode]:
        """Begin episodes, on the gateway's thread. Raises ClusterError if the manager can't be reached."""
        episodes = []
        for each in planned:
            running = await self._gateway.begin_episode(each.task, each.seed, sight=self._terms.sight)
            rules = self._terms.rules(each.task.oracle)
            if each.handover is not None:
                rules = replace(rules, calls=min(MAX_STEPS, rules.calls + each.handover), equal_failures=0)
            player = EpisodePlayer(running, each.task.situation, rules, self._codec, self._gateway.reward)
            episodes.append(ClusterEpisode(player, each.handover))
        await _all(episode.begin() for episode in episodes)
        return episodes

    def answer(self, episodes: Sequence[ClusterEpisode], texts: Sequence[str]) -> Future[list[str]]:
        """Give each episode an answer. The future has the observation after each, and fails as that of ``begin``."""
        return self._gateway.run(
            _all(episode.answer(text) for episode, text in zip(episodes, texts, strict=True))
        )


async def _all(work: Iterable[Awaitable[T]]) -> list[T]:
    return list(await asyncio.gather(*work))
