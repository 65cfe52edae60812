"""Process of a manager: election, gRPC server, HTTP server, and shutdown."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import dataclasses
import gc
import logging
import secrets
import signal
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import grpc
import uvicorn
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from embomatrix.host.limits import MIB
from embomatrix.manager.access.gate import Gate
from embomatrix.manager.access.protection import Tls, protection_of
from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.reputation import AuditRules
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.leadership import (
    Leadership,
    lease_key,
    note_folder,
    warn_of_another_folder,
)
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.services.listen import bound_socket
from embomatrix.manager.services.server import build_server
from embomatrix.manager.services.standby import Standby
from embomatrix.manager.settings import ManagerSettings, is_every_address, is_loopback
from embomatrix.manager.store.opening import open_store
from embomatrix.manager.store.protocol import Candidate, StateError, StateStore
from embomatrix.manager.web.api import build_api
from embomatrix.manager.web.connections import BoundedListener, allow_files, connections_of
from embomatrix.manager.web.http_rules import HttpRules, allowed_hosts

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery import Gallery

logger = logging.getLogger(__name__)

STOP_GRACE_S: Final = 0.5
"""Calls may finish during this time; workers and trainers then attach to the next manager."""
M_MMAP_THRESHOLD: Final = -3
"""Option of ``mallopt``."""
LARGE_BLOCK_BYTES: Final = 256 * 1024
YOUNG_OBJECTS: Final = 5_000
"""Objects allocated between two collections of the youngest generation, which take 2 ms."""
LimitsT = TypeVar("LimitsT", DispatchLimits, ScheduleLimits, LivenessLimits)


@dataclasses.dataclass(frozen=True, slots=True)
class Endpoints:
    """Addresses that a manager serves."""

    address: str
    """HOST:PORT of the gRPC services."""
    status_url: str


async def serve(
    settings: ManagerSettings,
    on_ready: Callable[[Endpoints], None],
    on_standby: Callable[[str], None] = lambda leader: None,
) -> None:
    """Serve until SIGINT or SIGTERM. Raises AccessError, StateError or PortInUseError with a remedy.

    ``on_standby`` receives the leader's address while another manager leads.
    """
    allow_files()
    _return_large_blocks()
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    leads = asyncio.Event()

    async def lead() -> None:
        async with running(settings, on_standby) as endpoints:
            leads.set()
            _collect_rarely()
            on_ready(endpoints)
            await stop.wait()

    leading = asyncio.create_task(lead())
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait((leading, stopping), return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not leads.is_set():
        leading.cancel()  # A standby has nothing to finish.
    with contextlib.suppress(asyncio.CancelledError):
        await leading


@contextlib.asynccontextmanager
async def running(
    settings: ManagerSettings, on_standby: Callable[[str], None] = lambda leader: None
) -> AsyncIterator[Endpoints]:
    """Run a manager while the context is held. It is entered when this manager leads."""
    protection = protection_of(settings)
    with _folder_errors(settings):
        total_bytes = settings.bundle_total_mb * MIB
        bundles = BundleStore(settings.data_dir / "bundles", total_bytes=total_bytes)
    async with contextlib.AsyncExitStack() as stack:
        # Ports are bound first: a manager that cannot serve must not take over the state.
        http_socket = stack.enter_context(
            bound_socket(settings.http_host, settings.http_port, option="http-")
        )
        with bound_socket(settings.host, settings.port) as probe:
            # gRPC binds it again below, with less specific errors.
            settings = settings.model_copy(update={"port": probe.getsockname()[1]})
        store = open_store(settings.state_url)
        stack.push_async_callback(store.close)
        with _folder_errors(settings):
            await warn_of_another_folder(store, settings.data_dir)
        leadership = Leadership(store, _candidate(settings))
        standby = Standby(protection.tls)
        http = _HttpServer(standby.page(), http_socket, protection.tls)
        # The first failing task ends the block; the end of the block cancels the tasks.
        group = await stack.enter_async_context(asyncio.TaskGroup())
        stack.callback(group.create_task(http.serve()).cancel)
        epoch = await _win(leadership, standby, settings, on_standby)
        runtime = await _start_runtime(settings, store, bundles, leadership, epoch)
        gate = Gate(store, guarded=protection.guarded, shared_token=settings.token)
        await gate.open(protection.first)
        server, port = await build_server(runtime, gate, protection.tls, settings)
        rules = HttpRules(
            gate, allowed_hosts(settings.http_host, protection.tls), secure=protection.tls is not None
        )
        http.show(build_api(runtime, rules, Revocation(runtime, gate), _gallery(settings.dataset)))
        stack.callback(group.create_task(leadership.keep()).cancel)
        stack.callback(group.create_task(runtime.serve()).cancel)
        await server.start()
        stack.push_async_callback(server.stop, STOP_GRACE_S)
        page_url = _page_url(settings.http_host, http_socket.getsockname()[1], protection.tls)
        yield Endpoints(f"{settings.host}:{port}", page_url)


def _collect_rarely() -> None:
    """Exempt all present objects from garbage collection, and collect less often.

    Rollouts in flight are many objects and no garbage: with the default thresholds the manager needs 22 % more CPU time
    per rollout.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS)


def _return_large_blocks() -> None:
    """Have the C library return large blocks of memory to the system when they are freed. GNU C library only.

    Messages have up to 32 MiB. By default the library keeps freed blocks of that size, by the hundred megabytes.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(M_MMAP_THRESHOLD, LARGE_BLOCK_BYTES)


def _page_url(host: str, port: int, tls: Tls | None) -> str:
    """Return the dashboard's URL. For a wildcard address its host is a name in the certificate, else this machine's
    name.
    """
    if is_every_address(host):
        names = () if tls is None else tls.names
        host = next((name for name in names if not is_loopback(name)), socket.gethostname())
    return f"{'http' if tls is None else 'https'}://{host}:{port}/"


def _gallery(dataset: Path | None) -> Gallery | None:
    if dataset is None:
        return None
    # Imported here: a manager without a dataset saves the 13 MB of memory that numpy and the code of scenes take.
    from embomatrix.manager.web.gallery import Gallery

    return Gallery(dataset)


def _candidate(settings: ManagerSettings) -> Candidate:
    # Only one process can be bound to this address, so a leader lease of the same holder belongs to an earlier
    # process of this manager.
    return Candidate(f"{socket.gethostname()}/{settings.address}", settings.address, settings.leader_ttl_s)


async def _win(
    leadership: Leadership,
    standby: Standby,
    settings: ManagerSettings,
    on_standby: Callable[[str], None],
) -> int:
    """Wait until this manager leads and return its epoch."""
    server: grpc.aio.Server | None = None

    async def stand_by(leader: str) -> None:
        nonlocal server
        standby.leader = leader
        if server is None:
            server = await standby.serve_calls(settings.host, settings.port)
        on_standby(leader)

    try:
        return await leadership.win(stand_by)
    finally:
        if server is not None:
            await server.stop(None)


def limits_of(kind: type[LimitsT], settings: ManagerSettings, **others: Any) -> LimitsT:
    """Return limits with the values of the settings of the same names, and ``others``; the rest has its defaults."""
    names = {field.name for field in dataclasses.fields(kind)} - others.keys()
    return kind(**settings.model_dump(include=names), **others)


async def _start_runtime(
    settings: ManagerSettings, store: StateStore, bundles: BundleStore, leadership: Leadership, epoch: int
) -> ManagerRuntime:
    with _folder_errors(settings):
        await note_folder(store, settings.data_dir)
    audit = AuditRules(settings.audit_probation, settings.audit_share, settings.audits_all_runs)
    # Epochs of sessions and leases exceed those of all earlier managers.
    first_epoch = (epoch << 32) + 1
    registry = Registry(limits_of(LivenessLimits, settings), first_epoch=first_epoch)
    cluster = ClusterState(
        limits_of(DispatchLimits, settings, audit=audit),
        limits_of(ScheduleLimits, settings),
        lease_key=await lease_key(store),
        first_epoch=first_epoch,
        audit_key=secrets.token_bytes(32),
        debug=logging.getLogger("embomatrix").isEnabledFor(logging.DEBUG),
    )
    archive = RunArchive(settings.data_dir / "runs")
    runtime = ManagerRuntime(
        cluster,
        registry,
        store,
        bundles,
        archive,
        results_ttl_s=settings.results_ttl_s,
        lapsed_s=leadership.lapsed_s,
        unrenewed=leadership.problem,
    )
    await runtime.start()
    return runtime


class _HttpServer:
    """Uvicorn on a bound socket, without its signal handlers, since the manager has its own."""

    def __init__(self, app: FastAPI, bound: BoundedListener, tls: Tls | None) -> None:
        self._socket = bound
        self._app = app
        config = uvicorn.Config(
            self._answer,
            interface="asgi3",
            http=connections_of(bound),
            # Uvicorn's log lines go through our handlers.
            log_config=None,
            log_level="warning",
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
            ssl_certfile=None if tls is None else tls.chain_file,
            ssl_keyfile=None if tls is None else tls.key_file,
        )
        self._server = uvicorn.Server(config)
        self._server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]

    def show(self, app: FastAPI) -> None:
        """Serve this application from now on."""
        self._app = app

    async def serve(self) -> None:
        try:
            await self._server.serve(sockets=[self._socket])
        finally:
            # A cancelled uvicorn leaves its listener in the event loop, where a later socket may get the same number.
            asyncio.get_running_loop().remove_reader(self._socket)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._app(scope, receive, send)


@contextlib.contextmanager
def _folder_errors(settings: ManagerSettings) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StateError(
            f"the data folder {settings.data_dir} can't be used ({error.strerror}): pass another --data-dir"
        ) from error
