"""Null worker as a process: ``python quick_worker_process.py MANAGER NAME SLOTS EXECUTE_S``."""

import asyncio
import os
import sys

from tests.fakes.worker import FakeWorker


async def run(manager, name, slots, execute_s):
    worker = FakeWorker(
        manager, worker_id=name, slots=int(slots), execute_s=float(execute_s), boot_id=str(os.getpid())
    )
    async with worker:
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(run(*sys.argv[1:]))
