"""The engine with a count of what benches ask about: how often something had to be settled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.engine import NOTHING, SETTLE_STEPS

if TYPE_CHECKING:
    from embomatrix.sim.engine import Settled


class CountingEngine(BulletEngine):
    """The engine, and how often something was settled in it."""

    settles = 0

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        self.settles += 1
        return super().settle(name, steps, ignore)
