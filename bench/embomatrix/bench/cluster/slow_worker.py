"""A worker whose scenes load slowly: ``python -m embomatrix.bench.cluster.slow_worker SECONDS MANAGER NAME SLOTS FOLDER``."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from embomatrix.worker.host.resources import measure
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon, serve


def main() -> None:
    """Serve until a signal comes; the simulator's program is the slowed one."""
    delay_s, manager, name, slots, folder = sys.argv[1:]
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)-7s %(message)s")
    values: dict[str, Any] = {"manager": manager, "name": name, "slots": slots, "cache_dir": Path(folder)}
    settings = WorkerSettings(**values)
    program = (sys.executable, "-m", "embomatrix.bench.cluster.slow_loading", delay_s)
    daemon = Daemon(settings, measure(settings), np.random.default_rng(), program=program)
    asyncio.run(serve(daemon, (signal.SIGINT, signal.SIGTERM)))


if __name__ == "__main__":
    main()
