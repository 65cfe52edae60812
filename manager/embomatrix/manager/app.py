"""Puts a manager together, serves until it is told to stop, and takes it apart again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import signal
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import uvicorn

from embomatrix.manager.api import build_api
from embomatrix.manager.archive import RunArchive
from embomatrix.manager.assignments import DispatchLimits
from embomatrix.manager.bundles import BundleStore
from embomatrix.manager.cluster_state import ClusterState
from embomatrix.manager.listen import bound_socket
from embomatrix.manager.registry import LivenessLimits, Registry
from embomatrix.manager.runtime import ManagerRuntime
from embomatrix.manager.scheduler import ScheduleLimits
from embomatrix.manager.server import build_server
from embomatrix.manager.store.protocol import StateError
from embomatrix.manager.store.url import open_store

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator, Callable, Iterator

    from fastapi import FastAPI

    from embomatrix.manager.settings import ManagerSettings
    from embomatrix.manager.store.protocol import StateStore

logger = logging.getLogger(__name__)

STOP_GRACE_S: Final = 0.5
"""Calls may end by themselves for this long; workers and trainers attach again to whoever comes next."""
MEGABYTE: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where a manager serves."""

    address: str
    """HOST:PORT of the gRPC services."""
    status_url: str


async def serve(settings: ManagerSettings, on_ready: Callable[[Endpoints], None]) -> None:
    """Serve until SIGINT or SIGTERM. ``StateError`` and ``PortInUseError`` tell a person what to mend."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    async with running(settings) as endpoints:
        on_ready(endpoints)
        await stop.wait()


@contextlib.asynccontextmanager
async def running(settings: ManagerSettings) -> AsyncIterator[Endpoints]:
    """A manager that serves for as long as this is held."""
    with _folder_errors(settings):
        bundles = BundleStore(
            settings.data_dir / "bundles",
            limit_bytes=settings.bundle_mb * MEGABYTE,
            total_bytes=settings.bundle_total_mb * MEGABYTE,
        )
    async with contextlib.AsyncExitStack() as stack:
        # Ports first: a manager that can't serve must not take the state from one that does.
        http_socket = stack.enter_context(
            bound_socket(settings.http_host, settings.http_port, option="http-")
        )
        with bound_socket(settings.host, settings.port):
            pass  # gRPC binds it again below, and would not tell why it can't
        store = open_store(settings.state_url)
        stack.push_async_callback(store.close)
        runtime = await _start_runtime(settings, store, bundles)
        server, port = await build_server(
            runtime,
            host=settings.host,
            port=settings.port,
            token=settings.token,
            lease_ttl_s=settings.lease_ttl_s,
        )
        http = _HttpServer(build_api(runtime, settings), http_socket)
        group = await stack.enter_async_context(_stopped_at_exit())
        group.create_task(runtime.serve())
        group.create_task(http.serve())
        await server.start()
        stack.push_async_callback(server.stop, STOP_GRACE_S)
        http_port = http_socket.getsockname()[1]
        yield Endpoints(f"{settings.host}:{port}", f"http://{settings.http_host}:{http_port}/")


async def _start_runtime(
    settings: ManagerSettings, store: StateStore, bundles: BundleStore
) -> ManagerRuntime:
    epoch = await store.claim()
    dispatch = DispatchLimits(
        lease_ttl_s=settings.lease_ttl_s,
        lease_limit_s=settings.lease_limit_s,
        execute_deadline_s=settings.execute_deadline_s,
        rollout_deadline_s=settings.rollout_deadline_s,
        no_capacity_s=settings.no_capacity_s,
        max_attempts=settings.max_attempts,
        restart_grace_s=settings.restart_grace_s,
    )
    schedule = ScheduleLimits(affinity_wait_s=settings.affinity_wait_s)
    liveness = LivenessLimits(
        heartbeat_s=settings.heartbeat_s,
        lost_after_s=settings.lost_after_s,
        stream_grace_s=settings.stream_grace_s,
    )
    # Epochs of this manager's sessions and leases lie above those of every manager before it.
    first_epoch = (epoch << 32) + 1
    registry = Registry(liveness, first_epoch=first_epoch)
    cluster = ClusterState(dispatch, schedule, boot_id=secrets.token_hex(4), first_epoch=first_epoch)
    archive = RunArchive(settings.data_dir / "runs")
    runtime = ManagerRuntime(cluster, registry, store, bundles, archive, results_ttl_s=settings.results_ttl_s)
    await runtime.start()
    return runtime


class _HttpServer:
    """Uvicorn on a socket that is bound already, without its signal handlers: the manager has its own."""

    def __init__(self, app: FastAPI, bound: socket.socket) -> None:
        self._socket = bound
        config = uvicorn.Config(
            app, log_level="warning", access_log=False, lifespan="off", timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]

    async def serve(self) -> None:
        await self._server.serve(sockets=[self._socket])


@contextlib.asynccontextmanager
async def _stopped_at_exit() -> AsyncIterator[asyncio.TaskGroup]:
    """A task group whose tasks are cancelled when the block ends, and whose first failure ends the block."""
    try:
        async with asyncio.TaskGroup() as group:
            yield group
            raise _BlockEndedError
    except* _BlockEndedError:
        pass


class _BlockEndedError(Exception):
    """The block ended; not an error."""


@contextlib.contextmanager
def _folder_errors(settings: ManagerSettings) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StateError(
            f"the data folder {settings.data_dir} can't be used ({error.strerror}): pass another --data-dir"
        ) from error
