"""What a slot executes from being taken to being given back, and what becomes of the rollouts and of its process.

A slot's process has the next plans in its stream before it has answered the last, so that it never waits for the daemon;
and while that is so, the daemon takes the answers of some milliseconds at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.reward.settings import PAPER
from embomatrix.rpc.wire.outcome import unread_completed
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.values import InfraCode, InfraFailure, Timings
from embomatrix.sim.zygote import PipeMessage
from embomatrix.worker.slots.processes import ProcessGoneError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from embomatrix.rpc.wire.leases import Lease
    from embomatrix.rpc.wire.values import Completed
    from embomatrix.worker.slots.residents import Residents, ResidentScene, Slot

    More = Callable[[int], Sequence["Ticket"]]
    Done = Callable[["Ticket", Completed | InfraFailure], None]

ROLLOUTS_PER_SLOT: Final = 5_000
GROWTH_MB: Final = 128.0
"""A slot's process is replaced after this many rollouts, or when it has grown by this much."""
AHEAD_S: Final = 0.06
"""Leases that wait in a slot's stream can't be given to another, nor taken back: they last about this long."""
MOST_AHEAD: Final = 24
LARGEST_AHEAD: Final = 4096
"""Bytes of a plan that may wait in a stream: its buffer holds all of them, and nobody waits to write."""
GATHER_S: Final = 0.025
"""Answers are taken at multiples of this time, of all slots at once: each time the daemon takes a core from a slot …"""
GATHER_SHARE: Final = 0.5
"""… or after this share of the time that the leases ahead will last, if that is less."""
LEAST_GATHER_S: Final = 0.002
RECENT: Final = 0.1
"""Weight of the last execution in the mean of those before it."""


@dataclass(slots=True, eq=False)
class Ticket:
    """A lease that waits or runs here."""

    lease: Lease
    taken_s: float
    found_warm: bool
    requeued: bool = False
    slot: int = 0
    """The permit that it has, from 1; 0 before."""
    began_s: float = 0.0
    """When it got the permit, on the monotonic clock."""
    turn_s: float = 0.0
    """When it was the first in its slot's stream: it may take its deadline from here."""
    called_off: bool = False
    """Nobody waits for its result."""

    @property
    def digest(self) -> str:
        return self.lease.rollout.bundle_digest

    def fits(self, digest: str) -> bool:
        """Whether its plan may wait in the stream of a slot of this scene."""
        return self.digest == digest and 0 < len(self.lease.rollout.wire) <= LARGEST_AHEAD


class Shift:
    """One permit at work in one scene: the leases in its slot's stream, of which the first is executed."""

    def __init__(self, permit: int, scene: ResidentScene) -> None:
        self.permit = permit
        self.scene = scene
        self.given: deque[Ticket] = deque()
        self.task: asyncio.Task[None] | None = None
        """What works it off."""

    def give(self, ticket: Ticket) -> None:
        """One more lease, behind the others."""
        ticket.slot = self.permit
        ticket.began_s = ticket.turn_s = time.monotonic()
        self.given.append(ticket)

    def call_off(self, ticket: Ticket) -> None:
        """Nobody waits for this one any more: what runs is killed, what waits in the stream gives no result."""
        ticket.called_off = True
        if self.given and self.given[0] is ticket and self.task is not None:
            self.task.cancel()

    async def work(self, slot: Slot, residents: Residents, *, more: More, done: Done) -> None:
        """Execute what was given, and what ``more`` gives up to a count meanwhile; ``done`` takes the outcomes.

        The slot is kept for the scene's next leases, or ended when one failed or it has done enough. Leases that are left
        in ``given`` were not begun, or were called off.
        """
        try:
            fit = await self._work_off(slot, more, done)
        except TimeoutError:
            residents.end_later(slot.child)
            late = f"the rollout took longer than its {self.given[0].lease.deadline_s:g} s and was killed"
            done(self.given.popleft(), InfraFailure(InfraCode.SLOT_TIMEOUT, late))
        except ProcessGoneError:
            how = await slot.child.end()
            died = f"the simulator ended during the rollout: {how}"
            done(self.given.popleft(), InfraFailure(InfraCode.SLOT_CRASHED, died))
        except BaseException:
            residents.end_later(slot.child)
            raise
        else:
            if fit and not slot.worn:
                residents.keep_slot(self.scene, slot)
            else:
                residents.end_later(slot.child)

    async def _work_off(self, slot: Slot, more: More, done: Done) -> bool:
        """Execute until nothing is left; tells whether the slot's process may execute more."""
        self.given[0].turn_s = time.monotonic()
        await _order(slot, self.given)
        waited = False
        while self.given:
            ahead = more(self._room()) if not slot.worn else ()
            if ahead:
                await _order(slot, ahead)
            # A long rollout is listened to: its stream is not looked into again and again.
            answers = await self._answers(slot, 0.0 if waited else self._pause_s())
            waited = not answers
            for answer in answers:
                if not self._take(answer, slot, done):
                    return False
            if self.given and self.given[0].called_off:
                return False
        return True

    def _take(self, answer: PipeMessage, slot: Slot, done: Done) -> bool:
        """Tells whether the process may execute more: what an exception left behind in it is unknown."""
        ticket = self.given.popleft()
        if "error" in answer.header:
            done(ticket, InfraFailure(InfraCode(answer.header["code"]), answer.header["error"]))
            return False
        _wear(slot, float(answer.header["resident_mb"]))
        done(ticket, self._completed(ticket, answer))
        if self.given:
            self.given[0].turn_s = time.monotonic()
        return True

    async def _answers(self, slot: Slot, pause_s: float) -> list[PipeMessage]:
        """What has come after the pause, or without one is waited for. Raises TimeoutError at the first lease's deadline."""
        peer = slot.child.peer
        if pause_s:
            return await peer.gathered(pause_s)
        first = self.given[0]
        left_s = first.turn_s + first.lease.deadline_s - time.monotonic()
        try:
            async with asyncio.timeout(left_s):
                return await peer.gathered(0.0)
        except TimeoutError:
            # It may have answered, and it is the next that takes long.
            if answers := peer.arrived():
                return answers
            raise

    def _room(self) -> int:
        """How many more leases the slot's stream may hold."""
        pace_s = self.scene.pace_s
        return min(MOST_AHEAD, int(AHEAD_S / pace_s)) - (len(self.given) - 1) if pace_s else 0

    def _pause_s(self) -> float:
        """For how long the answers may lie in the stream."""
        longest_s = GATHER_SHARE * self.scene.pace_s * (len(self.given) - 1)
        if longest_s < LEAST_GATHER_S:
            return 0.0
        common_s = GATHER_S - (time.monotonic() + LEAST_GATHER_S) % GATHER_S + LEAST_GATHER_S
        return min(common_s, longest_s)

    def _completed(self, ticket: Ticket, answer: PipeMessage) -> Completed:
        scene, execute_s = self.scene, float(answer.header["execute_s"])
        scene.pace_s += (execute_s - scene.pace_s) * (RECENT if scene.pace_s else 1.0)
        # Loading may have begun before the lease came.
        load_s = 0.0 if ticket.found_warm else min(scene.load_s, ticket.began_s - ticket.taken_s)
        timings = Timings(load_s=load_s, execute_s=execute_s)
        return unread_completed(answer.body, timings=timings, warm=ticket.found_warm)


async def _order(slot: Slot, tickets: Iterable[Ticket]) -> None:
    # Of a process that has died there may be answers to read, and then comes the end of its stream.
    with contextlib.suppress(ProcessGoneError):
        await slot.child.peer.post(_frame(ticket) for ticket in tickets)


def _frame(ticket: Ticket) -> PipeMessage:
    lease = ticket.lease
    own = {} if lease.reward is PAPER else {"reward": dataclasses.asdict(lease.reward)}
    header: dict[str, Any] = {"op": "execute", "slot": ticket.slot, **own}
    return PipeMessage(header, lease.rollout.wire or rollout_to_proto(lease.rollout).SerializeToString())


def _wear(slot: Slot, resident_mb: float) -> None:
    """Count a rollout; a slot that has done enough, or has grown, is worn."""
    slot.rollouts += 1
    slot.first_mb = slot.first_mb or resident_mb
    slot.worn = slot.rollouts >= ROLLOUTS_PER_SLOT or resident_mb > slot.first_mb + GROWTH_MB
