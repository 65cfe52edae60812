"""Worker daemon with the physics-free simulation.

``python worker_process.py MANAGER NAME FOLDER SLOTS [PREFERENCES [LIES]]``. PREFERENCES are JSON. The owner's terminals
are in FOLDER/devices. LIES is the share of rollouts with a fabricated reward.
"""

import asyncio
import json
import logging
import os
import signal
import sys
from pathlib import Path

import numpy as np

from embomatrix.rpc.wire.values import Resources
from embomatrix.worker.host.machine import HostMachine, Owner
from embomatrix.worker.host.owner_policy import Preferences
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon, serve

SIMULATION = Path(__file__).with_name("simulation.py")


def main():
    manager, name, folder, slots = sys.argv[1:5]
    wishes = Preferences(**json.loads(sys.argv[5])) if len(sys.argv) > 5 else Preferences()
    os.environ["FAKE_LIES"] = sys.argv[6] if len(sys.argv) > 6 else "0"
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    settings = WorkerSettings(
        manager=manager, name=name, cache_dir=Path(folder), state_dir=Path(folder), preferences=wishes
    )
    resources = Resources(int(slots), int(slots), 500, versions={"platform": "fake"})
    machine = HostMachine(lambda: [os.getpid()], Owner(Path(folder) / "devices", sessions=str))
    program = (sys.executable, str(SIMULATION))
    daemon = Daemon(settings, resources, np.random.default_rng(), program=program, probe=machine)
    asyncio.run(serve(daemon, (signal.SIGTERM, signal.SIGINT)))


if __name__ == "__main__":
    main()
