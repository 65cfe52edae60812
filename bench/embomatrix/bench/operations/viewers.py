"""What the dashboard costs with a thousand workers: the manager's time for ten viewers, and how fast a page is there."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
import statistics
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.bench.cluster.processes import running_process
from embomatrix.bench.operations.joining import wait_for
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.wire.leases import WorkerState
from embomatrix.rpc.wire.session import worker_state_to_proto
from embomatrix.rpc.wire.values import Resident, ResidentState, Resources
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.session import HEARTBEAT_S, register

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from embomatrix.bench.cluster.processes import Process
    from embomatrix.worker.link.session import Registration

WORKERS: Final = 1000
VIEWERS: Final = 10
LOOK_S: Final = 1.0
"""A page asks so often."""
MEASURED_S: Final = 15.0
SCENES: Final = 8
"""On each worker."""
AT_ONCE: Final = 16
"""That join at the same time."""
PAINTS: Final = 5
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
_SERVES: Final = re.compile(r"manager serves at (\S+:\d+), status page (\S+),")


def viewing(on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """A manager in a process of its own, workers that are only present, and viewers that ask as the page does."""
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        folder = Path(name)
        data = f"--data-dir={folder / 'manager'}"
        serve = ("embomatrix.cli", "manager", "serve", "--port=0", "--http-port=0", "--state=memory:", data)
        with running_process(folder, "manager", *serve) as manager:
            found = _SERVES.search(wait_for(manager, "status page"))
            if found is None:
                raise BenchError(f"the manager did not tell its addresses: see what it said, {manager.log}")
            return asyncio.run(_measured(found[1], found[2], manager, on_step))


async def _measured(
    address: str, page: str, manager: Process, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    on_step(f"{WORKERS} workers join")
    async with _present(address, WORKERS):
        on_step("the manager alone")
        alone = await _cpu_share(manager)
        on_step(f"{VIEWERS} viewers")
        viewers = [asyncio.create_task(_view(page)) for _ in range(VIEWERS)]
        watched = await _cpu_share(manager)
        for viewer in viewers:
            viewer.cancel()
        await asyncio.gather(*viewers, return_exceptions=True)
        on_step("a browser")
        paint_s = await asyncio.to_thread(_paint_s, page)
    return (
        Figure("dashboard_cpu_share", max(0.0, watched - alone), "share", Better.LOWER, VIEWERS, 0.05),
        Figure("dashboard_paint_s", paint_s, "s", Better.LOWER, PAINTS, 1.0),
    )


async def _cpu_share(manager: Process) -> float:
    """Of one core, over ``MEASURED_S``."""
    process = psutil.Process(manager.child.pid)
    before, started_s = process.cpu_times(), time.monotonic()
    await asyncio.sleep(MEASURED_S)
    after, taken_s = process.cpu_times(), time.monotonic() - started_s
    return float(after.user + after.system - before.user - before.system) / taken_s


@contextlib.asynccontextmanager
async def _present(address: str, count: int) -> AsyncIterator[None]:
    """So many workers that hold scenes and do nothing, over one connection."""
    few = asyncio.Semaphore(AT_ONCE)

    async def joined(number: int) -> Registration:
        async with few:
            resources = Resources(slots=2, cores=2, memory_mb=4096)
            return await register(
                Membership(address, f"present-{number:04}"), boot_id="present", resources=resources
            )

    registrations = await asyncio.gather(*map(joined, range(count)))
    async with open_channel(address) as channel:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        tasks = [asyncio.create_task(_stay(stub, each)) for each in registrations]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _stay(stub: worker_service_pb2_grpc.WorkerServiceAsyncStub, known: Registration) -> None:
    """Tell the full state once, then a heartbeat now and then."""
    residents = tuple(Resident(f"sha256:{n:064x}", ResidentState.WARM, 0.5, 30.0) for n in range(SCENES))
    state = worker_state_to_proto(WorkerState(residents, ()))

    session = stub.Session()
    await session.write(
        pb.SessionRequest(session_id=known.session_id, session_epoch=known.epoch, state=state)
    )

    async def listen() -> None:
        async for _ in session:
            pass

    async def beat() -> None:
        while True:
            await asyncio.sleep(known.heartbeat_s)
            request = pb.HeartbeatRequest(session_id=known.session_id, session_epoch=known.epoch, load=0.1)
            await stub.Heartbeat(request, timeout=HEARTBEAT_S)

    await asyncio.gather(listen(), beat())


async def _view(page: str) -> None:
    """Asks as the page of workers does."""
    while True:
        await asyncio.gather(asyncio.sleep(LOOK_S), asyncio.to_thread(_ask, page))


def _ask(page: str) -> None:
    with urllib.request.urlopen(f"{page}api/v1/snapshot?limit=50", timeout=5.0) as answer:
        answer.read()


def _paint_s(page: str) -> float:
    """Median time until a browser shows the workers, from asking for the page on. Raises BenchError without a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        browser = None
    if browser is None:
        raise BenchError(
            "a page is measured with Chromium and `pip install 'embomatrix[bench]'`: install both"
        )
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        taken_s: list[float] = []
        for _ in range(PAINTS):
            # A window of its own: nothing is in its cache.
            window = chromium.new_context().new_page()
            started_s = time.monotonic()
            window.goto(f"{page}#workers", wait_until="commit")
            window.wait_for_selector("#workers tbody tr")
            taken_s.append(time.monotonic() - started_s)
            window.context.close()
        chromium.close()
    return statistics.median(taken_s)
