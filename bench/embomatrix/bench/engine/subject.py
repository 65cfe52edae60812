"""What benches in one process measure: an engine that counts its settles, on a heap like a worker's."""

from __future__ import annotations

import contextlib
import gc
from typing import TYPE_CHECKING

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.engine import NOTHING, SETTLE_STEPS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.engine import Settled


class CountingEngine(BulletEngine):
    """The engine, and how often something was settled in it."""

    settles = 0

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        self.settles += 1
        return super().settle(name, steps, ignore)


@contextlib.contextmanager
def frozen_heap() -> Iterator[None]:
    """Keep what exists now out of garbage collections, and those out of rollouts, as the worker's slots do."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
