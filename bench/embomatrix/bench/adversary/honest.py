"""Honest null worker that joins with a token and registers again after its session ends, as a daemon does.

``python -m embomatrix.bench.adversary.honest ADDRESSES NAME TOKEN_FILE SLOTS`` runs one until killed. It waits
for the file, and tries the managers in turn.
"""

import asyncio
import contextlib
import itertools
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

import grpc

from embomatrix.bench.cluster.null_worker import MEMORY_MB, NullWorker
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Resources
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.session import register

AGAIN_S: Final = 0.2


def _token_in(file: Path) -> str:
    while not file.exists():
        time.sleep(AGAIN_S)
    return file.read_text(encoding="ascii")


async def main(addresses: str, name: str, token: str, slots: str) -> None:
    """Serve as one worker until killed."""
    member = Membership("", name, token, joining=True)
    resources = Resources(int(slots), int(slots), MEMORY_MB)
    for address in itertools.cycle(addresses.split(",")):
        member = replace(member, manager=address)
        with contextlib.suppress(ClusterError, ExceptionGroup):
            registration = await register(member, boot_id=name, resources=resources)
            if registration.credential:
                member = replace(member, token=registration.credential, joining=False)
            async with open_channel(address, member.token) as channel:
                stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
                with contextlib.suppress(grpc.aio.AioRpcError):
                    await NullWorker(registration, answers=True).run(stub, ())
        await asyncio.sleep(AGAIN_S)


if __name__ == "__main__":
    managers, name, token_file, slots = sys.argv[1:]
    asyncio.run(main(managers, name, _token_in(Path(token_file)), slots))
