"""Trainer process to be killed: ``python trainer_process.py MANAGER RUN COUNT TASK FILE`` logs results to FILE."""

import asyncio
import sys
from pathlib import Path

from tests.fakes.real_cluster import LIMITS, batch_of

from embomatrix.rpc.client import ClusterClient


async def main(manager, run_id, count, task, path):
    async with ClusterClient(manager, limits=LIMITS) as client:
        async for result in client.execute(batch_of(run_id, int(count), task)):
            note(path, result.rollout_id)


def note(path, rollout_id):
    with Path(path).open("a") as file:
        file.write(f"{rollout_id}\n")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
