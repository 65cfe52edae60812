"""Turns of closed-loop episodes: a client waits for each, and nothing about them is stored or kept after the answer."""

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from embomatrix.manager.control.commands import DeliverResult, FinishBatch
from embomatrix.manager.control.events import BatchCancelled, Event
from embomatrix.manager.runtime.runs import Runs
from embomatrix.rpc.wire.values import Batch, Rollout, RolloutResult

BATCH_ID_BYTES: Final = 8
"""Random bytes of a batch id: no trainer can guess it for a batch of its own."""


@dataclass(slots=True)
class _OpenStep:
    """Results of one call of ``Step`` so far, by id of the turn."""

    results: dict[str, RolloutResult] = field(default_factory=dict)
    finished: asyncio.Event = field(default_factory=asyncio.Event)


class OpenTurns:
    """Turns that are being executed. Each call is a batch of the dispatcher, and ``feed`` passes events to it."""

    def __init__(self, runs: Runs, feed: Callable[[Event], None]) -> None:
        self._runs = runs
        self._feed = feed
        self._open: dict[tuple[str, str], _OpenStep] = {}

    def __len__(self) -> int:
        return len(self._open)

    async def step(self, run_id: str, turns: tuple[Rollout, ...]) -> list[RolloutResult]:
        """Execute the turns and return the one result of each, in order. If the caller is cancelled, the turns are too.

        Raises as ``Runs.submit`` does, and then executes none.
        """
        batch = Batch(run_id, f"turns-{secrets.token_hex(BATCH_ID_BYTES)}", 0, turns)
        await self._runs.check_turns(batch)
        key = (run_id, batch.batch_id)
        step = self._open[key] = _OpenStep()
        try:
            self._runs.enter(batch)
            await step.finished.wait()
        finally:
            if not step.finished.is_set():
                self._feed(BatchCancelled(*key))
            del self._open[key]
        return [step.results[turn.rollout_id] for turn in turns]

    def take(self, command: DeliverResult | FinishBatch) -> bool:
        """Take the result of a turn, or the end of a call; False if the command is about another batch."""
        step = self._open.get((command.run_id, command.batch_id))
        if step is None:
            return False
        match command:
            case DeliverResult(_, _, result):
                step.results[result.rollout_id] = result
            case FinishBatch():
                step.finished.set()
        return True
