"""Manager inside this process. Its services are called with bytes and tokens, as over a network, but in a fixed order.

``run_in_order`` runs it without threads and without waiting.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import selectors
import traceback
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar
from unittest import mock

import grpc
from grpc.aio import AbortError

from embomatrix.manager.access.gate import Gate
from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.services.admin import AdminServicer
from embomatrix.manager.services.messages import BoundsInterceptor
from embomatrix.manager.services.rollout import RolloutServicer
from embomatrix.manager.services.scene import SceneServicer
from embomatrix.manager.services.server import RoleInterceptor
from embomatrix.manager.services.worker import WorkerServicer
from embomatrix.manager.store.opening import open_store
from embomatrix.manager.store.protocol import Candidate
from embomatrix.proto.v1 import (
    admin_service_pb2_grpc,
    rollout_service_pb2_grpc,
    scene_service_pb2_grpc,
    worker_service_pb2_grpc,
)
from embomatrix.rpc.channel import TOKEN_KEY, bearer

ADMIN: Final = "rehearsal-admin"
"""Secret of the manager's own operator. Nothing outside this process can reach it."""
SERVICES: Final = "/embomatrix.proto.v1."
BUNDLE_BYTES: Final = 10**9


T = TypeVar("T")


class _Selector(selectors.SelectSelector):
    """Selector that adds up the time for which a loop would wait, instead of waiting."""

    passed_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events = super().select(0)
        if not events and timeout:
            self.passed_s += timeout
        return events


class _Loop(asyncio.SelectorEventLoop):
    """Event loop whose clock advances only when nothing is ready to run."""

    def __init__(self) -> None:
        self._clock = _Selector()
        super().__init__(self._clock)
        self.set_default_executor(_NoThreads())

    def time(self) -> float:
        return self._clock.passed_s


class _NoThreads(ThreadPoolExecutor):
    """Executor that calls each function at once, in the same thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  # the caller awaits it
            future.set_exception(error)
        return future


def run_in_order(main: Coroutine[Any, Any, T]) -> T:
    """Run the coroutine like ``asyncio.run``, in an order that neither threads nor the duration of a call change.

    Sleeping takes no real time. ``sleep(0.001)`` returns when all other tasks wait for something.
    """
    # The manager reads the clock itself, for example to count messages in a second.
    with (
        asyncio.Runner(loop_factory=_Loop) as runner,
        mock.patch("time.monotonic", runner.get_loop().time),
    ):
        return runner.run(main)


class CallRefusedError(AbortError):  # type: ignore[misc]  # grpc is untyped
    """End of a call with a status other than OK."""

    def __init__(self, code: grpc.StatusCode, details: str) -> None:
        super().__init__(f"{code.name}: {details}")
        self.code = code


class _Written:
    """Answers of a call, and an event that each of them sets."""

    def __init__(self) -> None:
        self.answers: list[bytes] = []
        self.arrived = asyncio.Event()

    def add(self, message: Any) -> None:
        self.answers.append(message.SerializeToString())
        self.arrived.set()


class _Context:
    """Context of one call: its token, and the messages that the service writes."""

    def __init__(self, token: str, written: _Written) -> None:
        self._metadata = ((TOKEN_KEY, bearer(token)),) if token else ()
        self._written = written
        self._code: grpc.StatusCode | None = None
        self._details = ""

    def invocation_metadata(self) -> Sequence[tuple[str, str]]:
        return self._metadata

    async def write(self, message: Any) -> None:
        self._written.add(message)

    async def abort(self, code: grpc.StatusCode, details: str = "", trailing_metadata: Any = ()) -> None:
        del trailing_metadata
        raise CallRefusedError(code, details)

    def set_trailing_metadata(self, trailing_metadata: Any) -> None:
        """Ignore the metadata, which tells clients the reason of a refusal."""

    def set_code(self, code: grpc.StatusCode) -> None:
        self._code = code

    def set_details(self, details: str) -> None:
        self._details = details

    def end(self, answer: Any = None) -> None:
        """End the call with its answer, if it has one. Raise CallRefusedError if its service set a code."""
        if self._code is not None:
            raise CallRefusedError(self._code, self._details)
        if answer is not None:
            self._written.add(answer)


@dataclass(frozen=True)
class _Details:
    """Method and metadata of a call, as interceptors see them."""

    method: str
    invocation_metadata: Sequence[tuple[str, str]]


class _Methods:
    """Stand-in for a gRPC server that keeps the handler of each method."""

    def __init__(self) -> None:
        self.handlers: dict[str, grpc.RpcMethodHandler] = {}

    def add_generic_rpc_handlers(self, handlers: object) -> None:
        del handlers  # the same as those below

    def add_registered_method_handlers(
        self, service: str, handlers: Mapping[str, grpc.RpcMethodHandler]
    ) -> None:
        self.handlers |= {f"/{service}/{name}": handler for name, handler in handlers.items()}


class _Tracebacks(logging.Handler):
    """Collects the tracebacks of unexpected errors."""

    def __init__(self, found: list[str]) -> None:
        super().__init__(logging.ERROR)
        self._found = found

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            self._found.append("".join(traceback.format_exception(record.exc_info[1])))


@dataclass
class OpenCall:
    """Open call whose requests are sent one by one."""

    task: asyncio.Task[str]
    """Returns the name of the status at the end of the call."""
    requests: asyncio.Queue[bytes | None]
    written: _Written

    def taken(self) -> list[bytes]:
        """Return the answers since the last call."""
        answers, self.written.answers = self.written.answers, []
        self.written.arrived.clear()
        return answers

    async def more(self) -> list[bytes]:
        """Wait for answers and return them; none once the call has ended."""
        arrival = asyncio.create_task(self.written.arrived.wait())
        await asyncio.wait((arrival, self.task), return_when=asyncio.FIRST_COMPLETED)
        arrival.cancel()
        return self.taken()

    def send(self, data: bytes) -> None:
        self.requests.put_nowait(data)

    def close(self) -> None:
        """Send no more requests."""
        self.requests.put_nowait(None)

    @property
    def status(self) -> str:
        """Name of the status that ended the call; empty while it runs."""
        if not self.task.done():
            return ""
        return "CANCELLED" if self.task.cancelled() else self.task.result()


@dataclass
class ManagerInside:
    """Manager with tokens, its state in memory. ``tracebacks`` are those of unexpected errors."""

    runtime: ManagerRuntime
    gate: Gate
    handlers: Mapping[str, grpc.RpcMethodHandler]
    tracebacks: list[str] = field(default_factory=list)

    async def call(self, method: str, token: str, payloads: Sequence[bytes]) -> tuple[str, list[bytes]]:
        """Make a call of any shape, SERVICE/CALL. Return the name of its status and its answers."""
        stream = self.open(method, token)
        for payload in payloads:
            stream.send(payload)
        stream.close()
        await asyncio.wait([stream.task])
        return stream.status, stream.taken()

    def open(self, method: str, token: str) -> OpenCall:
        """Start a call of any shape."""
        requests: asyncio.Queue[bytes | None] = asyncio.Queue()
        written = _Written()
        task = asyncio.create_task(self._status(SERVICES + method, token, requests, written))
        return OpenCall(task, requests, written)

    async def _status(
        self, method: str, token: str, requests: asyncio.Queue[bytes | None], written: _Written
    ) -> str:
        try:
            await self._serve(method, token, requests, written)
        except CallRefusedError as refused:
            return str(refused.code.name)
        return "OK"

    async def _serve(
        self, method: str, token: str, requests: asyncio.Queue[bytes | None], written: _Written
    ) -> None:
        context = _Context(token, written)
        handler = await self._handler(_Details(method, context.invocation_metadata()))

        async def incoming() -> AsyncIterator[bytes]:
            while (data := await requests.get()) is not None:
                yield data

        if handler.request_streaming:
            request: Any = incoming()
        elif (request := await requests.get()) is None:
            return
        if handler.response_streaming and handler.request_streaming:
            await handler.stream_stream(request, context)
        elif handler.response_streaming:
            async for answer in handler.unary_stream(request, context):
                written.add(answer)
        else:
            serve = handler.stream_unary if handler.request_streaming else handler.unary_unary
            context.end(await serve(request, context))
        context.end()

    async def _handler(self, details: _Details) -> grpc.RpcMethodHandler:
        async def known(found: _Details) -> grpc.RpcMethodHandler:
            return self.handlers[found.method]

        async def bounded(found: _Details) -> grpc.RpcMethodHandler:
            return await BoundsInterceptor().intercept_service(known, found)

        return await RoleInterceptor(self.gate).intercept_service(bounded, details)


@contextlib.asynccontextmanager
async def manager_inside(folder: Path) -> AsyncIterator[ManagerInside]:
    """Run a manager with bundles and archive in the folder while the context is held."""
    store = open_store("memory:")
    await store.claim(Candidate("inside", "inside:1", 3600.0))
    # Fixed keys and session ids, so that equal sequences of calls take equal decisions.
    numbers = itertools.count(1)
    registry = Registry(LivenessLimits(), new_id=lambda: f"{next(numbers):016x}")
    cluster = ClusterState(lease_key=b"rehearsal", audit_key=b"rehearsal")
    bundles = BundleStore(folder / "bundles", total_bytes=BUNDLE_BYTES)
    runtime = ManagerRuntime(cluster, registry, store, bundles, RunArchive(folder / "runs"))
    gate = Gate(store, guarded=True, shared_token=ADMIN)
    await runtime.start()
    await gate.open()
    methods = _Methods()
    worker_service_pb2_grpc.add_WorkerServiceServicer_to_server(
        WorkerServicer(runtime, gate, lease_ttl_s=30.0), methods
    )
    rollout_service_pb2_grpc.add_RolloutServiceServicer_to_server(
        RolloutServicer(runtime.runs, runtime.turns, runtime.training, gate), methods
    )
    scene_service_pb2_grpc.add_SceneServiceServicer_to_server(SceneServicer(bundles), methods)
    admin_service_pb2_grpc.add_AdminServiceServicer_to_server(
        AdminServicer(runtime, gate, Revocation(runtime, gate)), methods
    )
    found = ManagerInside(runtime, gate, methods.handlers)
    handler, logger = _Tracebacks(found.tracebacks), logging.getLogger("embomatrix")
    serving = asyncio.create_task(runtime.serve())
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        await store.close()
