"""Trainer on another machine: ``python far_trainer_process.py MANAGER COUNT TASK FILE WORKER`` logs results as JSON lines.

It begins when the worker is ready.
"""

import asyncio
import json
import sys
from pathlib import Path

from tests.fakes.real_cluster import LIMITS, batch_of, connected, opened

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Completed


async def main(manager, count, task, path, worker):
    async with ClusterClient(manager, limits=LIMITS) as client:
        await connected(client, worker)
        batch = batch_of(await opened(client), int(count), task)
        async for result in client.execute(batch, deadline_s=300.0):
            note(path, result)
        stats = await client.close_run(batch.run_id)
    print(f"{stats.redispatched} re-dispatched, {stats.stale_results} stale results")


def note(path, result):
    outcome = result.outcome
    got = outcome.reward.total if isinstance(outcome, Completed) else type(outcome).__name__
    with Path(path).open("a") as file:
        file.write(json.dumps([result.rollout_id, got]) + "\n")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
