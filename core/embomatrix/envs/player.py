"""An episode played by answers in words: from the opening prompt to its end.

The player reads a policy's answers, executes their calls turn by turn, on a cluster or in this process, and tells the policy
what happened. It keeps the rules; the simulator knows nothing of them.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.envs.observer import Observer
from embomatrix.envs.rules import EpisodeEnd, EpisodeReward, EpisodeRules, Visibility
from embomatrix.reward.hierarchy import unparsable
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.skills.episode_text import left_out, not_an_action
from embomatrix.skills.parse import PlanError, parse_answer
from embomatrix.skills.prompt import Codec, with_indices
from embomatrix.skills.syntax import Skill

if TYPE_CHECKING:
    from embomatrix.reward.turns import RunningEpisode, Turn
    from embomatrix.skills.prompt import Prompt, Situation
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.skills.trace import Step
    from embomatrix.skills.turns import Advice


@dataclass(frozen=True, slots=True)
class Observation:
    """Text that a policy is told after an answer, with its facts.

    ``steps`` are the outcomes of the answer's calls, with the names of the simulator; ``messages`` those in the policy's words.
    """

    text: str
    steps: tuple[Step, ...]
    messages: tuple[str, ...]
    reward: EpisodeReward
    end: EpisodeEnd | None
    """Reason why the episode is over; None while it goes on."""


class EpisodePlayer:
    """One episode of a task under rules.

    ``running`` executes the calls; it must have sight if the rules say ``seen``. ``situation`` is the task's at its start.
    """

    def __init__(
        self,
        running: RunningEpisode,
        situation: Situation,
        rules: EpisodeRules,
        codec: Codec = Codec.LINES,
        reward: RewardSettings = PAPER,
    ) -> None:
        self._running = running
        self._situation = situation
        self._rules = rules
        self.codec = codec
        self._seen = rules.visibility is Visibility.SEEN
        if self._seen and not running.start.sight:
            raise ValueError("the rules show only what the robot has seen: expected an episode with sight")
        self.observer = Observer(situation, codec, rules.visibility)
        self.steps: list[Step] = []
        """Outcomes of all calls so far, refused ones included."""
        self.end: EpisodeEnd | None = None
        self.reward = EpisodeReward(unparsable(reward))
        self.observation: Observation | None = None
        """Observation after the latest answer."""
        self._repeated: SkillCall | str = ""
        self._repeats = 0
        self._way: tuple[SkillCall, ...] = ()

    async def begin(self) -> Prompt:
        """Return the opening prompt. Raises what ``RunningEpisode.act`` raises."""
        start = (await self._running.look()).observation if self._seen else None
        return self.observer.begin(start, self._rules.calls_per_answer)

    async def answer(self, text: str) -> Observation:
        """Take a policy's answer: one call, or ``done``. Text without a call counts as a failed call.

        Raises RuntimeError after the end, and what ``RunningEpisode.act`` raises; then the episode is as before.
        """
        calls, done, notes = self._read(text)
        return await self.act(calls, done=done, notes=notes, text=text)

    async def act(
        self,
        calls: Sequence[SkillCall],
        *,
        done: bool = False,
        notes: Sequence[str] = (),
        text: str = "",
    ) -> Observation:
        """Execute calls up to the first failure, as ``answer`` does with those of a ``text``. ``done`` ends the episode."""
        if self.end is not None:
            raise RuntimeError(f"the episode is over ({self.end}): begin another")
        most = min(self._rules.calls_per_answer, self._rules.calls - self.reward.calls)
        steps, turn, were_unknown = await self._execute(calls[:most])
        if len(calls) > most or were_unknown:
            notes = (*notes, left_out(len(calls), len(steps)))
            done = False
        self.steps += steps
        for call in (step.call for step in steps if step.ok):
            if call.skill in (Skill.MOVE, Skill.GO_TO_ROOM):
                self._way = (call,)
            elif call.skill in (Skill.TURN, Skill.MOVE_FORWARD):
                self._way += (call,)
        self._count(steps, turn, unread=None if steps or done else text)
        observed = turn.observation if turn is not None else None
        told = self.observer.tell(steps, observed, self.reward.calls, notes)
        self.end = self._ending(done=done and all(step.ok for step in steps))
        messages = self.observer.outcomes(steps)
        self.observation = Observation(told, tuple(steps), messages, self.reward, self.end)
        return self.observation

    @property
    def state(self) -> Hashable:
        """State as the policy knows it, and how the robot came to stand where it stands. Earlier calls don't matter."""
        return self.observer.situation, self._way

    async def advise(self) -> Advice:
        """Ask the oracle for a plan from here on, which names objects that the policy may not have seen. Counts as no call.

        Raises what ``RunningEpisode.advise`` raises.
        """
        return await self._running.advise()

    def stop(self, end: EpisodeEnd = EpisodeEnd.TOKENS) -> None:
        """End the episode from outside."""
        self.end = self.end or end

    def says_done(self, text: str) -> bool:
        """Return whether an answer ends the episode without a call."""
        calls, done, _ = self._read(text)
        return done and not calls

    def _read(self, text: str) -> tuple[Plan, bool, list[str]]:
        """Return the calls of an answer, whether it ends the episode, and notes about it."""
        words = with_indices(text, self.observer.naming) if self.codec is Codec.NAMES else text
        try:
            return *parse_answer(words, self._situation.profile), []
        except PlanError as error:
            return (), False, [not_an_action(error, self.codec)]

    async def _execute(self, calls: Sequence[SkillCall]) -> tuple[list[Step], Turn | None, bool]:
        """Execute calls up to the first that fails, and refuse those with unknown rows without execution.

        Return true at last if calls were left out because the calls before them brought their rows into sight: the policy
        could not know these rows when it answered.
        """
        allowed: list[SkillCall] = []
        refused: Step | None = None
        for call in calls:
            refused = self.observer.refusal(call)
            if refused is not None:
                break
            allowed.append(call)
        turn = await self._running.act(allowed) if allowed else None
        steps = [*turn.steps] if turn is not None else []
        if refused is None or len(steps) < len(allowed) or (steps and not steps[-1].ok):
            return steps, turn, False
        if turn is not None and self.observer.comes_to_know(refused.call, turn.observation):
            return steps, turn, True
        return [*steps, refused], turn, False

    def _count(self, steps: Sequence[Step], turn: Turn | None, *, unread: str | None) -> None:
        """Count the calls of an answer, or an answer that could not be read, and how often the same one failed in a row."""
        for step in steps:
            self._repeats = 0 if step.ok else 1 + (self._repeats if step.call == self._repeated else 0)
            self._repeated = step.call
        if unread is not None:
            self._repeats = 1 + (self._repeats if unread == self._repeated else 0)
            self._repeated = unread
        calls = self.reward.calls + len(steps) + (unread is not None)
        failures = self.reward.failures + sum(not step.ok for step in steps) + (unread is not None)
        cost = self._rules.call_cost * calls + self._rules.failure_cost * failures
        tiers = turn.reward if turn is not None else self.reward.tiers
        self.reward = EpisodeReward(tiers, calls, failures, cost)

    def _ending(self, *, done: bool) -> EpisodeEnd | None:
        if done:
            return EpisodeEnd.DONE
        if self._rules.ends_at_goal and self.reward.tiers.success:
            return EpisodeEnd.GOAL
        if self.reward.calls >= self._rules.calls:
            return EpisodeEnd.CALLS
        if 0 < self._rules.equal_failures <= self._repeats:
            return EpisodeEnd.LOOP
        return None
