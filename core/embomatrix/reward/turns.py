"""Closed-loop episodes: calls in turns, each with an outcome, an observation and the reward so far."""

from __future__ import annotations

from collections.abc import Awaitable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from embomatrix.skills.turns import EpisodePrefix, check_length

if TYPE_CHECKING:
    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.skills.trace import Step
    from embomatrix.skills.turns import Advice, TurnObservation


@dataclass(frozen=True, slots=True)
class Turn:
    """Result of an episode's next calls. They end at the first failure, after which the episode may go on."""

    steps: tuple[Step, ...]
    observation: TurnObservation
    reward: RewardBreakdown
    """Reward of all calls so far, as if the episode ended here."""
    digest: str
    """Digest of the episode so far: its task, its seed, and the states after all its calls."""


@dataclass(frozen=True, slots=True)
class EpisodeStart:
    """Start of an episode: a task of a bundle, and the seed that decides between equally good outcomes.

    With ``sight``, observations name the rows of the task's table that the robot sees.
    """

    bundle_digest: str
    task_id: str
    seed: int
    sight: bool = False


class TakeTurn(Protocol):
    """Executes the calls of a plan after its prefix. With ``advise``, the observation has the oracle's advice."""

    def __call__(
        self, start: EpisodeStart, plan: Plan, prefix: EpisodePrefix, *, advise: bool = False
    ) -> Awaitable[Turn]: ...


class RunningEpisode:
    """Episode that goes on turn by turn. It holds all that is known about it: nothing else must be kept anywhere.

    ``take_turn`` executes turns: of a cluster, or in this process.
    """

    def __init__(self, start: EpisodeStart, take_turn: TakeTurn) -> None:
        self.start = start
        self.calls: Plan = ()
        """Calls so far, failed ones included."""
        self.prefix = EpisodePrefix()
        """Length, failed calls and digest of ``calls``."""
        self._take_turn = take_turn
        self._acting = False

    async def look(self) -> Turn:
        """Observe the present state without a call, in an episode with sight. Counts as no call.

        Raises what ``act`` raises.
        """
        return await self._take(())

    async def act(self, calls: Sequence[SkillCall]) -> Turn:
        """Execute further calls, up to the first that fails. After an error the episode is as before, and may act again.

        Raises EpisodeOverError for no call and for more than 64 in all, PrefixMismatchError if the calls so far have other
        outcomes now, and RuntimeError during another turn of this episode.
        """
        check_length(self.calls, tuple(calls))
        return await self._take(tuple(calls))

    async def advise(self) -> Advice:
        """Ask the oracle, which sees the goal and the whole state, for a plan from the present state. Counts as no call.

        Raises what ``act`` raises, and RuntimeError if ``take_turn`` gives no advice.
        """
        advice = (await self._take((), advise=True)).observation.advice
        if advice is None:
            raise RuntimeError("the turn has no advice: expected it of every turn that asks")
        return advice

    async def _take(self, further: Plan, *, advise: bool = False) -> Turn:
        if self._acting:
            raise RuntimeError("the episode is within a turn: await it before the next one")
        check_length(self.calls, further, only_looks=self.start.sight or advise)
        self._acting = True
        try:
            plan = (*self.calls, *further)
            turn = await self._take_turn(self.start, plan, self.prefix, advise=advise)
        finally:
            self._acting = False
        self.calls = (*self.calls, *further[: len(turn.steps)])
        self.prefix = self.prefix.after(turn.steps, turn.digest)
        return turn
