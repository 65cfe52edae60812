"""Worker whose scenes load slowly, as those of heavier simulators do: each load waits for a stated time first.

``python -m embomatrix.bench.cluster.slow_loading worker SECONDS MANAGER NAME SLOTS FOLDER`` runs the worker, which starts the
simulator by ``… simulator SECONDS FD PARENT``.
"""

import asyncio
import logging
import signal
import sys
import time
from pathlib import Path
from typing import Any

from embomatrix.worker.slots.physics import Physics, PhysicsScene
from embomatrix.worker.slots.slot_program import run_program


class SlowPhysics(Physics):
    """Simulation that waits ``delay_s`` seconds before it loads a scene, in the process that will hold the scene."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s

    def load(self, path: Path, digest: str, *, sharing: bool) -> PhysicsScene:
        time.sleep(self._delay_s)
        return super().load(path, digest, sharing=sharing)


def serve(delay_s: str, manager: str, name: str, slots: str, folder: str) -> None:
    """Run the worker until a signal comes."""
    import numpy as np

    from embomatrix.worker.host import resources, settings
    from embomatrix.worker.link import daemon

    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)-7s %(message)s")
    values: dict[str, Any] = {
        "manager": manager,
        "name": name,
        "slots": slots,
        "cache_dir": Path(folder),
        "sharing": False,
    }
    chosen = settings.WorkerSettings(**values)
    program = (sys.executable, "-m", "embomatrix.bench.cluster.slow_loading", "simulator", delay_s)
    worker = daemon.Daemon(chosen, resources.measure(chosen), np.random.default_rng(), program=program)
    asyncio.run(daemon.serve(worker, (signal.SIGINT, signal.SIGTERM)))


if __name__ == "__main__":
    if sys.argv.pop(1) == "worker":
        serve(*sys.argv[1:])
    else:
        run_program(SlowPhysics(float(sys.argv.pop(1))))
