"""Manager inside the test process, with tokens and TLS as `embomatrix manager init` sets them up."""

import contextlib
import functools
import zlib
from dataclasses import dataclass
from pathlib import Path

from tests.fakes import waiting
from tests.fakes.worker import FakeWorker

from embomatrix.manager.access.folder import AccessFolder, prepare
from embomatrix.manager.services.app import running
from embomatrix.manager.settings import ManagerSettings
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Batch, Rollout
from embomatrix.world.inflation import bundle_digest


@dataclass
class Guarded:
    """Address of a manager and the credentials for it."""

    address: str
    page: str
    ca: bytes
    folder: AccessFolder

    def token(self, role):
        return self.folder.token(role).read_text().strip()

    def operator(self):
        return AdminClient(self.address, self.token(AccessRole.ADMIN), ca=self.ca)

    async def issue(self, role, **options):
        async with self.operator() as operator:
            return (await operator.issue_token(role, **options))[0]


@contextlib.asynccontextmanager
async def guarded(data_dir: Path, **changes):
    """Prepare the folder once and serve a manager from it; other options are the manager's."""
    prepare(data_dir, sans=("127.0.0.1",), roles=tuple(AccessRole))
    folder = AccessFolder(data_dir)
    options = {
        "port": 0,
        "http_port": 0,
        "heartbeat_s": 0.1,
        "stream_grace_s": 0.2,
        "data_dir": data_dir,
        **changes,
    }
    async with running(ManagerSettings(**options)) as at:
        yield Guarded(at.address, at.status_url, folder.ca.read_bytes(), folder)


def packed(content):
    """Return the digest and the bytes of a bundle with this content."""
    data = zlib.compress(content.encode())
    return bundle_digest(data), data


KITCHEN, KITCHEN_DATA = packed("a kitchen")
BEDROOM, BEDROOM_DATA = packed("a bedroom")


def rollouts(count, *, task="t", scene=KITCHEN):
    return tuple(Rollout(f"x{i}", "g", scene, task, (), i) for i in range(count))


until = functools.partial(waiting.until, limit_s=10.0)


@contextlib.asynccontextmanager
async def trainer(at):
    async with ClusterClient(at.address, at.token(AccessRole.TRAINER), ca=at.ca) as client:
        await client.open_run("test", "r1")
        await client.put_bundles({KITCHEN: KITCHEN_DATA, BEDROOM: BEDROOM_DATA})
        yield client


def worker(at, name, **options):
    return FakeWorker(at.address, worker_id=name, ca=at.ca, boot_id=f"boot of {name}", **options)


async def joined(at, name, **options):
    """Return a worker that joined with a dedicated token."""
    return worker(at, name, join_token=await at.issue(AccessRole.JOIN), **options)


async def collect(client, count):
    return [result async for result in client.execute(Batch("r1", "b1", 1, rollouts(count)), deadline_s=30)]
