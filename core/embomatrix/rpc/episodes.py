"""Closed-loop episodes on a cluster: turns that are awaited together travel together.

A turn depends on nothing but its own content: the cluster keeps nothing of an episode, so every retry is safe.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from embomatrix.host.backoff import Backoff
from embomatrix.reward.turns import EpisodeStart, RunningEpisode, Turn
from embomatrix.rpc.status import (
    ClusterError,
    InternalError,
    InvalidRequestError,
    OverloadedError,
    PreconditionError,
    UnavailableError,
)
from embomatrix.rpc.wire.bounds import TURNS
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraCode, InfraFailure, Outcome, Rollout
from embomatrix.skills.turns import PrefixMismatchError

if TYPE_CHECKING:
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.turns import EpisodePrefix

CALLS: Final = 4
"""Calls of ``Step`` in flight. While all are, further turns gather for the next one."""
LEAST_TURNS: Final = 4
"""Turns of a call, if so many wait. A call costs the client and the manager as much as several turns."""
_TRANSIENT: Final = (UnavailableError, OverloadedError)
"""Errors after which the same turns are sent again."""
_OF_ONE_TURN: Final = (InvalidRequestError, PreconditionError, InternalError)
"""Errors that one turn may cause for all turns of its call."""


class TurnFailedError(ClusterError):
    """Turn without a result: every attempt failed, or its run was closed. The episode may act again.

    ``failure`` is what the manager says about the last attempt, if it does.
    """

    def __init__(self, message: str, failure: InfraFailure | None = None) -> None:
        super().__init__(message)
        self.failure = failure


@dataclass(frozen=True, slots=True)
class _AwaitedTurn:
    rollout: Rollout
    outcome: asyncio.Future[Outcome]


class Episodes:
    """Async context manager over the episodes of one run, any number side by side.

    Up to ``calls`` calls are in flight. A call that a turn is sent with answers when all its turns have ended.
    """

    def __init__(self, client: ClusterClient, run_id: str, *, calls: int = CALLS) -> None:
        self._client = client
        self._run_id = run_id
        self._calls = calls
        self._numbers = itertools.count(1)
        self._waiting: deque[_AwaitedTurn] = deque()
        self._sending: set[asyncio.Task[None]] = set()
        self._gathering = False
        self.used_s = time.monotonic()
        """Monotonic time of the latest turn, or of the beginning."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """Give up the turns that are still awaited."""
        for turn in self._waiting:
            turn.outcome.cancel()
        self._waiting.clear()
        for task in self._sending:
            task.cancel()
        await asyncio.gather(*self._sending, return_exceptions=True)

    def begin(
        self, bundle_digest: str, task_id: str, seed: int = 0, *, sight: bool = False
    ) -> RunningEpisode:
        """Begin an episode, without a call to the manager.

        Besides what ``RunningEpisode.act`` says, a turn raises InvalidRequestError for an unknown task and for a skill outside
        its profile, PreconditionError if the manager lacks the bundle, NotFoundError if the run is not open, TurnFailedError if
        no worker could execute it, and DeadlineError or UnavailableError after the client's time limit for a turn.
        """
        return RunningEpisode(EpisodeStart(bundle_digest, task_id, seed, sight), self._take_turn)

    async def _take_turn(
        self, start: EpisodeStart, plan: Plan, prefix: EpisodePrefix, *, advise: bool = False
    ) -> Turn:
        self.used_s = time.monotonic()
        name = str(next(self._numbers))
        rollout = Rollout(
            name,
            name,
            start.bundle_digest,
            start.task_id,
            plan,
            start.seed,
            prefix=prefix,
            sight=start.sight,
            advise=advise,
        )
        awaited = _AwaitedTurn(rollout, asyncio.get_running_loop().create_future())
        self._waiting.append(awaited)
        self._gather()
        turn = _turn_of(await awaited.outcome)
        if advise and turn.observation.advice is None:
            raise TurnFailedError(
                "the manager sent a turn without the oracle's advice: upgrade it and its workers"
            )
        return turn

    def _gather(self) -> None:
        """Send waiting turns soon, if a call may be made: those that are asked for meanwhile go with them."""
        if self._waiting and not self._gathering and len(self._sending) < self._calls:
            self._gathering = True
            asyncio.get_running_loop().call_soon(self._send_waiting)

    def _send_waiting(self) -> None:
        self._gathering = False
        while self._waiting and (free := self._calls - len(self._sending)) > 0:
            share = -(-len(self._waiting) // free)
            count = min(len(self._waiting), max(share, LEAST_TURNS), TURNS)
            turns = [self._waiting.popleft() for _ in range(count)]
            task = asyncio.create_task(self._send([turn for turn in turns if not turn.outcome.done()]))
            self._sending.add(task)
            task.add_done_callback(functools.partial(self._sent, turns))

    def _sent(self, turns: Sequence[_AwaitedTurn], task: asyncio.Task[None]) -> None:
        self._sending.discard(task)
        for turn in turns:
            turn.outcome.cancel()  # without effect on one that is done
        self._gather()

    async def _send(self, turns: Sequence[_AwaitedTurn]) -> None:
        """Execute the turns in one call, and give each its outcome or the error."""
        abandoned = _cancel_when_abandoned(turns)
        try:
            if turns:
                await self._settle(turns)
        except asyncio.CancelledError:
            if not abandoned():
                raise

    async def _settle(self, turns: Sequence[_AwaitedTurn]) -> None:
        try:
            outcomes = await self._outcomes([turn.rollout for turn in turns])
        except _OF_ONE_TURN as error:
            if len(turns) > 1:
                # Find the turn that is at fault: no other one gets its error.
                half = len(turns) // 2
                await self._settle(turns[:half])
                await self._settle(turns[half:])
            else:
                _fail(turns, error)
        except Exception as error:  # noqa: BLE001  # whoever awaits a turn gets its error
            _fail(turns, error)
        else:
            for turn, outcome in zip(turns, outcomes, strict=True):
                if not turn.outcome.done():
                    turn.outcome.set_result(outcome)

    async def _outcomes(self, turns: Sequence[Rollout]) -> list[Outcome]:
        """Execute the turns, and again after a transient error until the time limit."""
        limits = self._client.limits
        ends_s = time.monotonic() + limits.turn_s
        backoff = Backoff(limits.retry_first_s, limits.retry_longest_s)
        while True:
            try:
                results = await self._client.step(
                    self._run_id, turns, timeout_s=max(ends_s - time.monotonic(), 0.0)
                )
                return [result.outcome for result in results]
            except _TRANSIENT:
                wait_s = backoff.next_s()
                if time.monotonic() + wait_s >= ends_s:
                    raise
            await asyncio.sleep(wait_s)


def _cancel_when_abandoned(turns: Sequence[_AwaitedTurn]) -> Callable[[], bool]:
    """Cancel the present task once nobody awaits any of the turns. Return a function that says whether that is so."""
    task = asyncio.current_task()
    assert task is not None

    def abandoned() -> bool:
        return all(turn.outcome.cancelled() for turn in turns)

    def check(outcome: asyncio.Future[Outcome]) -> None:
        if outcome.cancelled() and abandoned():
            task.cancel()

    for turn in turns:
        turn.outcome.add_done_callback(check)
    return abandoned


def _fail(turns: Sequence[_AwaitedTurn], error: Exception) -> None:
    for turn in turns:
        if not turn.outcome.done():
            turn.outcome.set_exception(error)


def _turn_of(outcome: Outcome) -> Turn:
    match outcome:
        case Completed(observation=observation) if observation is not None:
            return Turn(outcome.steps, observation, outcome.reward, outcome.trace_digest)
        case Completed():
            raise TurnFailedError("the manager sent a result without an observation: upgrade its workers")
        case InfraFailure(InfraCode.PREFIX_MISMATCH, message):
            raise PrefixMismatchError(message)
        case InfraFailure(code, message):
            raise TurnFailedError(f"the turn has no result ({code}): {message}", InfraFailure(code, message))
        case Cancelled(reason):
            raise TurnFailedError(f"the turn was cancelled: {reason}; is its run still open?")
