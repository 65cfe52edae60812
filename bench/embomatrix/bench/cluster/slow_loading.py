"""The simulator with loading slowed: ``python -m embomatrix.bench.cluster.slow_loading SECONDS FD PARENT``.

Scenes of other simulators take seconds to load. A wait that is stated stands for it, so that look-ahead and dispatch can be
measured at that scale: whoever loads sleeps first, in the process that will hold the scene.
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from embomatrix.worker.slots.physics import Physics
from embomatrix.worker.slots.slot_program import run_program

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.worker.slots.physics import PhysicsScene


class SlowPhysics(Physics):
    """Loads bundles as the worker does, ``delay_s`` seconds later."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s

    def load(self, path: Path, digest: str) -> PhysicsScene:
        time.sleep(self._delay_s)
        return super().load(path, digest)


if __name__ == "__main__":
    run_program(SlowPhysics(float(sys.argv.pop(1))))
