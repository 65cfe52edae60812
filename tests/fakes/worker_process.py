"""A worker daemon with the simulation that needs no physics: ``python worker_process.py MANAGER NAME FOLDER SLOTS``."""

import asyncio
import logging
import signal
import sys
from pathlib import Path

import numpy as np

from embomatrix.rpc.values import Resources
from embomatrix.worker.daemon import Daemon, serve
from embomatrix.worker.settings import WorkerSettings

SIMULATION = Path(__file__).with_name("simulation.py")


def main():
    manager, name, folder, slots = sys.argv[1:]
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    settings = WorkerSettings(manager=manager, name=name, cache_dir=Path(folder), state_dir=Path(folder))
    resources = Resources(int(slots), int(slots), 500)
    daemon = Daemon(settings, resources, np.random.default_rng(), program=(sys.executable, str(SIMULATION)))
    asyncio.run(serve(daemon, (signal.SIGTERM, signal.SIGINT)))


if __name__ == "__main__":
    main()
