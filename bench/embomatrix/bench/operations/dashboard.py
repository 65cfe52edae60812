"""Cost of the dashboard with a thousand workers: the manager's CPU time for ten viewers, and the time to paint a page."""

import asyncio
import contextlib
import shutil
import statistics
import tempfile
import time
import urllib.request
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final

import psutil

from embomatrix.bench.cluster.cpu import cpu_s
from embomatrix.bench.cluster.null_worker import NullWorker, register_null_worker
from embomatrix.bench.cluster.processes import SERVES, Process, running_manager
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import open_channel
from embomatrix.worker.link.session import Registration

WORKERS: Final = 1000
VIEWERS: Final = 10
REFRESH_S: Final = 1.0
"""Refresh interval of the page."""
MEASURED_S: Final = 15.0
SCENES: Final = tuple(f"sha256:{number:064x}" for number in range(8))
"""Residents of each worker."""
SIMULTANEOUS: Final = 16
"""Workers that join at the same time."""
PAINTS: Final = 5
START_S: Final = 120.0
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")


def measure_dashboard(on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Run a manager in a process, null workers, and viewers that poll as the page does.

    Without a browser the time to paint is left out.
    """
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        options = ("--state=memory:", f"--data-dir={Path(name) / 'manager'}")
        with running_manager(Path(name), *options) as manager:
            address, page = manager.wait_for(SERVES, time.monotonic() + START_S).groups()
            return asyncio.run(_measured(address, page, manager, on_step))


def browser_path() -> str | None:
    """Path of a Chromium that Playwright can drive; None if either is missing."""
    with contextlib.suppress(ModuleNotFoundError):
        import playwright  # noqa: F401

        return next(filter(None, map(shutil.which, BROWSERS)), None)
    return None


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
        share = max(0.0, watched - alone)
        figures = (Figure("dashboard_cpu_share", share, "share", Better.LOWER, VIEWERS, 0.05),)
        if (browser := browser_path()) is None:
            return figures
        on_step("a browser")
        paint_s = await asyncio.to_thread(_paint_s, page, browser)
    return (*figures, Figure("dashboard_paint_s", paint_s, "s", Better.LOWER, PAINTS, 1.0))


async def _cpu_share(manager: Process) -> float:
    """Share of one core that the manager uses, over ``MEASURED_S``."""
    process = psutil.Process(manager.child.pid)
    before_s, started_s = cpu_s(process), time.monotonic()
    await asyncio.sleep(MEASURED_S)
    return (cpu_s(process) - before_s) / (time.monotonic() - started_s)


@contextlib.asynccontextmanager
async def _present(address: str, count: int) -> AsyncIterator[None]:
    """Null workers that hold scenes, over one connection."""
    permits = asyncio.Semaphore(SIMULTANEOUS)

    async def join(number: int) -> Registration:
        async with permits:
            return await register_null_worker(address, f"present-{number:04}", slots=2)

    registrations = await asyncio.gather(*map(join, range(count)))
    async with open_channel(address) as channel:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        workers = [asyncio.create_task(NullWorker(each).run(stub, SCENES)) for each in registrations]
        try:
            yield
        finally:
            for worker in workers:
                worker.cancel()
            await asyncio.gather(*workers, return_exceptions=True)


async def _view(page: str) -> None:
    """Poll as the page of workers does."""

    def poll() -> None:
        with urllib.request.urlopen(f"{page}api/v1/snapshot?limit=50", timeout=5.0) as answer:
            answer.read()

    while True:
        await asyncio.gather(asyncio.sleep(REFRESH_S), asyncio.to_thread(poll))


def _paint_s(page: str, browser: str) -> float:
    """Median time from the request of the page until the browser shows the workers, with an empty cache."""
    from playwright.sync_api import Error, sync_playwright

    taken_s: list[float] = []
    try:
        with sync_playwright() as driver:
            chromium = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
            for _ in range(PAINTS):
                window = chromium.new_context().new_page()
                started_s = time.monotonic()
                window.goto(f"{page}#workers", wait_until="commit")
                window.wait_for_selector("#workers tbody tr")
                taken_s.append(time.monotonic() - started_s)
                window.context.close()
            chromium.close()
    except Error as error:
        raise BenchError(f"the dashboard can't be painted by {browser}: {error}") from error
    return statistics.median(taken_s)
