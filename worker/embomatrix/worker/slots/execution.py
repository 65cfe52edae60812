"""Execution of leases in one slot, from the permit to the results.

A slot's process has its next plans in its stream before it has answered the last one, so it never waits for the daemon.
Meanwhile the daemon reads answers in batches of some milliseconds.
"""

import asyncio
import contextlib
import dataclasses
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from embomatrix.reward.settings import PAPER
from embomatrix.rpc.wire.leases import Lease
from embomatrix.rpc.wire.outcome import unread_completed
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure, Timings
from embomatrix.sim.zygote import PipeMessage
from embomatrix.worker.slots.processes import ProcessGoneError
from embomatrix.worker.slots.residents import Residents, ResidentScene, Slot
from embomatrix.worker.slots.slot_program import SOUND

TakeMore = Callable[[int], Sequence["HeldLease"]]
Finish = Callable[["HeldLease", Completed | InfraFailure], None]

ROLLOUTS_PER_SLOT: Final = 5_000
GROWTH_MB: Final = 128.0
"""A slot's process is replaced after this many rollouts, or if it has grown by this much."""
TURN_WEAR: Final = 0.1
"""Rollouts that a turn of an episode counts for: it has one new call, and a new process must execute prefixes again."""
AHEAD_S: Final = 0.06
"""Execution time of the leases in a slot's stream. Other slots can't take them over, and the manager can't take them back."""
MOST_AHEAD: Final = 24
LARGEST_AHEAD: Final = 4096
"""Largest plan in bytes that may wait in a stream: the buffer holds all of them, so no write blocks."""
GATHER_S: Final = 0.025
"""Answers of all slots are read at multiples of this interval, because each reading takes a core from a slot."""
GATHER_SHARE: Final = 0.5
"""Answers of a slot are read after this share of the time that its leases ahead will last, if that is less."""
LEAST_GATHER_S: Final = 0.002
RECENT: Final = 0.1
"""Weight of the last execution in the moving average of execution times."""


@dataclass(slots=True, eq=False)
class HeldLease:
    """Lease that waits or runs on this worker. Times are on the monotonic clock."""

    lease: Lease
    taken_s: float
    found_warm: bool
    requeued: bool = False
    slot: int = 0
    """Number of its permit, from 1; 0 before it has one."""
    began_s: float = 0.0
    """Time at which it got the permit."""
    first_since_s: float = 0.0
    """Time at which it became the first of its slot's stream; its deadline counts from here."""
    cancelled: bool = False

    @property
    def digest(self) -> str:
        return self.lease.rollout.bundle_digest

    def fits(self, digest: str) -> bool:
        """Return whether its plan may wait in the stream of a slot of this scene."""
        return self.digest == digest and 0 < len(self.lease.rollout.wire) <= LARGEST_AHEAD


class SlotRun:
    """One occupied permit in one scene. ``queue`` are the leases in the slot's stream; the first is executing."""

    def __init__(self, permit: int, scene: ResidentScene) -> None:
        self.permit = permit
        self.scene = scene
        self.queue: deque[HeldLease] = deque()
        self.task: asyncio.Task[None] | None = None

    def add(self, held: HeldLease) -> None:
        """Append a lease."""
        held.slot = self.permit
        held.began_s = held.first_since_s = time.monotonic()
        self.queue.append(held)

    def cancel(self, held: HeldLease) -> None:
        """Cancel a lease: an executing one is killed, a queued one gives no result."""
        held.cancelled = True
        if self.queue and self.queue[0] is held and self.task is not None:
            self.task.cancel()

    async def execute(self, slot: Slot, residents: Residents, *, more: TakeMore, finish: Finish) -> None:
        """Execute the queue, and the leases that ``more`` adds up to a count; ``finish`` gets the outcomes.

        The slot is kept for the scene's next leases, or ended if one failed or the slot is worn. Leases that remain in
        ``queue`` were not begun, or were cancelled.
        """
        try:
            reusable = await self._execute(slot, more, finish)
        except TimeoutError:
            residents.end_later(slot.child)
            late = f"the rollout took longer than its {self.queue[0].lease.deadline_s:g} s and was killed"
            finish(self.queue.popleft(), InfraFailure(InfraCode.SLOT_TIMEOUT, late))
        except ProcessGoneError:
            how = await slot.child.end()
            died = f"the simulator ended during the rollout: {how}"
            finish(self.queue.popleft(), InfraFailure(InfraCode.SLOT_CRASHED, died))
        except BaseException:
            residents.end_later(slot.child)
            raise
        else:
            if reusable and not slot.worn:
                residents.keep_slot(self.scene, slot)
            else:
                residents.end_later(slot.child)

    async def _execute(self, slot: Slot, more: TakeMore, finish: Finish) -> bool:
        """Execute until the queue is empty; return whether the slot's process may execute more."""
        self.queue[0].first_since_s = time.monotonic()
        await _post(slot, self.queue)
        empty = False
        while self.queue:
            ahead = more(self._room()) if not slot.worn else ()
            if ahead:
                await _post(slot, ahead)
            # After a pause without answers the rollout is long: its stream is awaited, not polled.
            answers = await self._answers(slot, 0.0 if empty else self._pause_s())
            empty = not answers
            for answer in answers:
                if not self._accept(answer, slot, finish):
                    return False
            if self.queue and self.queue[0].cancelled:
                return False
        return True

    def _accept(self, answer: PipeMessage, slot: Slot, finish: Finish) -> bool:
        """Return whether the process may execute more: after an exception its state is unknown."""
        held = self.queue.popleft()
        if "error" in answer.header:
            finish(held, InfraFailure(InfraCode(answer.header["code"]), answer.header["error"]))
            sound = bool(answer.header.get(SOUND))
            if sound and self.queue:
                self.queue[0].first_since_s = time.monotonic()
            return sound
        _wear(slot, float(answer.header["resident_mb"]), TURN_WEAR if held.lease.rollout.is_turn else 1.0)
        finish(held, self._completed(held, answer))
        if self.queue:
            self.queue[0].first_since_s = time.monotonic()
        return True

    async def _answers(self, slot: Slot, pause_s: float) -> list[PipeMessage]:
        """Return the answers that came during the pause; without a pause wait for one.

        Raise TimeoutError at the first lease's deadline.
        """
        peer = slot.child.peer
        if pause_s:
            return await peer.gathered(pause_s)
        first = self.queue[0]
        left_s = first.first_since_s + first.lease.deadline_s - time.monotonic()
        try:
            async with asyncio.timeout(left_s):
                return await peer.gathered(0.0)
        except TimeoutError:
            # The first may have answered just now, and only the next one takes long.
            if answers := peer.arrived():
                return answers
            raise

    def _room(self) -> int:
        """Number of leases that the slot's stream may hold in addition."""
        mean_s = self.scene.execute_mean_s
        return min(MOST_AHEAD, int(AHEAD_S / mean_s)) - (len(self.queue) - 1) if mean_s else 0

    def _pause_s(self) -> float:
        """Time that answers may wait in the stream."""
        if any(held.lease.rollout.is_turn for held in self.queue):
            return 0.0  # clients wait
        longest_s = GATHER_SHARE * self.scene.execute_mean_s * (len(self.queue) - 1)
        if longest_s < LEAST_GATHER_S:
            return 0.0
        common_s = GATHER_S - (time.monotonic() + LEAST_GATHER_S) % GATHER_S + LEAST_GATHER_S
        return min(common_s, longest_s)

    def _completed(self, held: HeldLease, answer: PipeMessage) -> Completed:
        scene, execute_s = self.scene, float(answer.header["execute_s"])
        scene.execute_mean_s += (execute_s - scene.execute_mean_s) * (RECENT if scene.execute_mean_s else 1.0)
        # Loading may have begun before the lease came.
        load_s = 0.0 if held.found_warm else min(scene.load_s, held.began_s - held.taken_s)
        timings = Timings(load_s=load_s, execute_s=execute_s)
        return unread_completed(answer.body, timings=timings, warm=held.found_warm)


async def _post(slot: Slot, leases: Iterable[HeldLease]) -> None:
    # A dead process may have left answers to read; the end of its stream is noticed after them.
    with contextlib.suppress(ProcessGoneError):
        await slot.child.peer.post(_frame(held) for held in leases)


def _frame(held: HeldLease) -> PipeMessage:
    lease = held.lease
    reward = {} if lease.reward is PAPER else {"reward": dataclasses.asdict(lease.reward)}
    header: dict[str, Any] = {"op": "execute", "slot": held.slot, **reward}
    return PipeMessage(header, lease.rollout.wire or rollout_to_proto(lease.rollout).SerializeToString())


def _wear(slot: Slot, resident_mb: float, rollouts: float) -> None:
    """Count rollouts; a slot with many rollouts, or one that has grown, is worn."""
    slot.rollouts += rollouts
    slot.first_mb = slot.first_mb or resident_mb
    slot.worn = slot.rollouts >= ROLLOUTS_PER_SLOT or resident_mb > slot.first_mb + GROWTH_MB
