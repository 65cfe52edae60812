"""One lease in a slot of its scene: what becomes of the rollout, and of the process that executed it."""

from __future__ import annotations

import asyncio
import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.convert import completed_from_proto, rollout_to_proto
from embomatrix.rpc.values import InfraCode, InfraFailure, Timings
from embomatrix.sim.zygote import Frame
from embomatrix.worker.processes import ProcessGoneError

if TYPE_CHECKING:
    from embomatrix.rpc.values import Completed, Lease
    from embomatrix.worker.residents import Residents, Scene, Slot

ROLLOUTS_PER_SLOT: Final = 5_000
GROWTH_MB: Final = 128.0
"""A slot's process is replaced after this many rollouts, or when it has grown by this much."""


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
    task: asyncio.Task[None] | None = None

    @property
    def digest(self) -> str:
        return self.lease.rollout.bundle_digest


async def execute(ticket: Ticket, scene: Scene, slot: Slot, residents: Residents) -> Completed | InfraFailure:
    """Run the rollout; the slot is kept for the scene's next one, or ended when it failed or has done enough."""
    body = ticket.lease.rollout.wire or rollout_to_proto(ticket.lease.rollout).SerializeToString()
    try:
        async with asyncio.timeout(ticket.lease.deadline_s):
            answer = await slot.child.peer.ask(Frame(_order(ticket), body))
    except TimeoutError:
        residents.end_later(slot.child)
        late = f"the rollout took longer than its {ticket.lease.deadline_s:g} s and was killed"
        return InfraFailure(InfraCode.SLOT_TIMEOUT, late)
    except ProcessGoneError:
        how = await slot.child.end()
        return InfraFailure(InfraCode.SLOT_CRASHED, f"the simulator ended during the rollout: {how}")
    except asyncio.CancelledError:
        residents.end_later(slot.child)
        raise
    return _outcome(ticket, scene, slot, answer, residents)


def _order(ticket: Ticket) -> dict[str, Any]:
    reward = ticket.lease.reward
    own = {} if reward is PAPER else {"reward": dataclasses.asdict(reward)}
    return {"op": "execute", "slot": ticket.slot, **own}


def _outcome(
    ticket: Ticket, scene: Scene, slot: Slot, answer: Frame, residents: Residents
) -> Completed | InfraFailure:
    header = answer.header
    if "error" in header:
        # What an exception left behind in the process is unknown.
        residents.end_later(slot.child)
        return InfraFailure(InfraCode(header["code"]), header["error"])
    if _worn(slot, float(header["resident_mb"])):
        residents.end_later(slot.child)
    else:
        residents.keep_slot(scene, slot)
    return _completed(ticket, scene, answer)


def _completed(ticket: Ticket, scene: Scene, answer: Frame) -> Completed:
    timings = Timings(
        # Loading may have begun before the lease came.
        load_s=0.0 if ticket.found_warm else min(scene.load_s, ticket.began_s - ticket.taken_s),
        execute_s=float(answer.header["execute_s"]),
    )
    completed = completed_from_proto(types_pb2.Completed.FromString(answer.body))
    return completed.noted(timings=timings, warm=ticket.found_warm)


def _worn(slot: Slot, resident_mb: float) -> bool:
    """Count a rollout, and tell whether the slot has done enough."""
    slot.rollouts += 1
    slot.first_mb = slot.first_mb or resident_mb
    return slot.rollouts >= ROLLOUTS_PER_SLOT or resident_mb > slot.first_mb + GROWTH_MB
