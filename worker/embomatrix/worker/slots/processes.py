"""Simulator processes as the daemon sees them: start the root, fork children, exchange messages, end them."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
import socket
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.host.limits import MIB
from embomatrix.sim.zygote import PREFIX_BYTES, PipeMessage, frame_lengths, pack, unpack

if TYPE_CHECKING:
    from embomatrix.worker.slots.slot_program import ProgressBoard

SIMULATOR_PROGRAM: Final = (sys.executable, "-m", "embomatrix.worker.slots.physics")
LOG_BYTES: Final = 10 * MIB
"""The engine's output begins anew at a start beyond this size."""
LAST_BYTES: Final = 4_096
"""End of the output in which the last line is looked for."""
START_S: Final = 60.0
"""Limit for a root to import the engine on a busy machine."""
ENVIRONMENT: Final = {
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Without huge pages a respawn takes 1.5 times as long. The C library reads the variable before Python starts."""
FORK_S: Final = 10.0
REAP_S: Final = 5.0
READ_BYTES: Final = 64 * 1024
"""Bytes read from a stream at once: more than most answers have."""


class ProcessGoneError(Exception):
    """Process at the other end of a stream that has died."""


class ProcessChannel:
    """Message stream to one process. It is made and used on one event loop and stays registered with it."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._connection = connection
        self._turn = asyncio.Lock()
        self._buffer = bytearray()
        self._gone = ""
        self._listener: asyncio.Future[None] | None = None
        self._listening = False
        self._listen()

    async def ask(self, frame: PipeMessage) -> PipeMessage:
        """Send a request with its descriptors and wait for the answer. Raise ProcessGoneError.

        After a cancelled request the stream is out of step, and the process must be ended.
        """
        async with self._turn:
            try:
                await self._send(frame)
            except OSError as error:
                raise ProcessGoneError(str(error)) from error
            return await self.receive()

    async def receive(self) -> PipeMessage:
        """Wait for the next frame."""
        header_bytes, body_bytes = frame_lengths(await self._take(PREFIX_BYTES))
        return unpack(await self._take(header_bytes + body_bytes), header_bytes)

    async def post(self, frames: Iterable[PipeMessage]) -> None:
        """Send requests in one write; their answers are read by ``gathered``. Raise ProcessGoneError."""
        try:
            await self._send_all(b"".join(map(pack, frames)))
        except OSError as error:
            raise ProcessGoneError(str(error)) from error

    async def gathered(self, pause_s: float) -> list[PipeMessage]:
        """Return the frames that came during the pause; without a pause wait for at least one.

        Raise ProcessGoneError if none came and none can come.
        """
        if pause_s > 0:
            # Without a reader during the pause: each answer would wake this process.
            self._stop_listening()
            await asyncio.sleep(pause_s)
            return self.arrived()
        # Let other tasks run between two answers, however fast the process is.
        await asyncio.sleep(0)
        while not (frames := self.arrived()):
            self._listen()
            await self._wait_for_data()
        return frames

    def arrived(self) -> list[PipeMessage]:
        """Return all complete frames. Raise ProcessGoneError if there is none and the stream has ended."""
        while not self._gone and self._read() == READ_BYTES:
            pass
        frames, at = [], 0
        while len(self._buffer) - at >= PREFIX_BYTES:
            begin = at + PREFIX_BYTES
            header_bytes, body_bytes = frame_lengths(bytes(self._buffer[at:begin]))
            end = begin + header_bytes + body_bytes
            if end > len(self._buffer):
                break
            frames.append(unpack(bytes(self._buffer[begin:end]), header_bytes))
            at = end
        del self._buffer[:at]
        if self._gone and not frames:
            raise ProcessGoneError(self._gone)
        return frames

    def close(self) -> None:
        """Close the stream. Tasks that wait for an answer on it must be cancelled."""
        if self._connection.fileno() >= 0:
            # Callbacks left behind would fire for the next socket with the same descriptor number.
            self._stop_listening()
            asyncio.get_running_loop().remove_writer(self._connection)
        self._connection.close()

    def _listen(self) -> None:
        """Register the reader once: registering it for each answer costs more than reading the answer."""
        if not self._listening and not self._gone:
            asyncio.get_running_loop().add_reader(self._connection, self._readable)
            self._listening = True

    def _stop_listening(self) -> None:
        if self._listening:
            asyncio.get_running_loop().remove_reader(self._connection)
            self._listening = False

    async def _send(self, frame: PipeMessage) -> None:
        data = pack(frame)
        # A request finds the buffer empty, so most are sent at once. Descriptors go with the first byte.
        sent = socket.send_fds(self._connection, [data], list(frame.fds)) if frame.fds else 0
        await self._send_all(data[sent:])

    async def _send_all(self, data: bytes) -> None:
        sent = self._send_now(data) if data else 0
        if sent < len(data):
            await asyncio.get_running_loop().sock_sendall(self._connection, data[sent:])

    def _send_now(self, data: bytes) -> int:
        try:
            return self._connection.send(data)
        except BlockingIOError:
            return 0

    async def _take(self, count: int) -> bytes:
        """Wait for ``count`` bytes. Raise ProcessGoneError if the stream ends before."""
        while len(self._buffer) < count:
            if self._gone:
                raise ProcessGoneError(self._gone)
            self._listen()
            await self._wait_for_data()
        taken = bytes(memoryview(self._buffer)[:count])
        del self._buffer[:count]
        return taken

    async def _wait_for_data(self) -> None:
        """Wait until data has come or the stream has ended."""
        self._listener = asyncio.get_running_loop().create_future()
        try:
            await self._listener
        finally:
            self._listener = None

    def _readable(self) -> None:
        self._read()
        if self._listener is not None and not self._listener.done():
            self._listener.set_result(None)

    def _read(self) -> int:
        """Read available bytes up to a limit and return their number."""
        try:
            part = self._connection.recv(READ_BYTES)
            self._gone = "" if part else "its stream ended"
        except BlockingIOError:
            return 0
        except OSError as error:
            part, self._gone = b"", str(error)
        self._buffer += part
        if self._gone:
            self._stop_listening()
        return len(part)


class Zygote:
    """Process that forks children: the root, or one that holds a scene."""

    def __init__(self, peer: ProcessChannel) -> None:
        self.peer = peer
        self._requests: set[asyncio.Task[PipeMessage]] = set()

    async def fork(self, limit_s: float = FORK_S) -> Child:
        """Fork a child and connect to it. Raise ProcessGoneError if the zygote has died or does not answer."""
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                answer = await self._ask(PipeMessage({"op": "fork"}, fds=(os.dup(theirs.fileno()),)), limit_s)
        except BaseException:
            ours.close()
            raise
        return Child(self, ProcessChannel(ours), int(answer.header["pid"]))

    async def reap(self, pid: int) -> str:
        """Collect a child that has ended and return how it ended."""
        answer = await self._ask(PipeMessage({"op": "reap", "pid": pid}), REAP_S)
        return describe_status(int(answer.header["status"]))

    def close(self) -> None:
        """Close the stream to a process that is given up, and cancel its open requests."""
        for request in self._requests:
            request.cancel()
        self.peer.close()

    async def _ask(self, frame: PipeMessage, limit_s: float) -> PipeMessage:
        """Complete the request even if the caller is cancelled, because other slots need this stream in step."""
        request = asyncio.create_task(self.peer.ask(frame))
        self._requests.add(request)
        request.add_done_callback(functools.partial(self._answered, frame))
        try:
            async with asyncio.timeout(limit_s):
                # Not awaited directly: giving the process up cancels the request and not the caller.
                await asyncio.wait((request,))
        except TimeoutError as error:
            raise ProcessGoneError(f"it did not answer within {limit_s:g} s") from error
        if request.cancelled():
            raise ProcessGoneError("it was ended")
        return request.result()

    def _answered(self, frame: PipeMessage, request: asyncio.Task[PipeMessage]) -> None:
        self._requests.discard(request)
        for fd in frame.fds:
            os.close(fd)
        if not request.cancelled():
            request.exception()  # the caller may be gone: retrieve the exception here


class Child(Zygote):
    """Forked process that answers requests and may fork children."""

    def __init__(self, parent: Zygote, peer: ProcessChannel, pid: int) -> None:
        super().__init__(peer)
        self.pid = pid
        self._parent = parent

    def kill(self) -> None:
        """Kill the process. It must be ended later, or its process id is never free again."""
        self.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    async def end(self) -> str:
        """Kill the process and return how it ended; a process that had died before keeps its reason."""
        self.kill()
        try:
            return await self._parent.reap(self.pid)
        except ProcessGoneError as error:
            return f"its exit status is unknown: {error}"


class Root(Zygote):
    """Spawned process that imported the engine, without any thread or lock of the daemon."""

    def __init__(self, peer: ProcessChannel, process: asyncio.subprocess.Process, memory_mb: float) -> None:
        super().__init__(peer)
        self.memory_mb = memory_mb
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    async def end(self) -> None:
        """Kill the process; its children die with it."""
        self.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        await self._process.wait()


async def start_root(
    log: Path, program: tuple[str, ...] = SIMULATOR_PROGRAM, board: ProgressBoard | None = None
) -> Root:
    """Spawn the root and wait until it has imported the engine. Raise ProcessGoneError with the reason.

    Slots write their progress to the ``board``, if there is one. The output of the engine goes to ``log``, because Bullet
    writes warnings to standard output.
    """
    await asyncio.to_thread(_shorten, log)
    ours, theirs = socket.socketpair()
    shared = () if board is None else (board.fd,)
    with theirs, log.open("ab") as output:
        process = await asyncio.create_subprocess_exec(
            *program,
            str(theirs.fileno()),
            str(os.getpid()),
            *map(str, shared),
            pass_fds=(theirs.fileno(), *shared),
            env={**os.environ, **ENVIRONMENT},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            # Ctrl-C reaches every process of the terminal's group, but the simulator must outlive a drain.
            start_new_session=True,
        )
    peer = ProcessChannel(ours)
    try:
        async with asyncio.timeout(START_S):
            answer = await peer.receive()
    except (ProcessGoneError, TimeoutError, OSError) as error:
        await Root(peer, process, 0.0).end()
        message = (await asyncio.to_thread(_last_line, log)) or str(error)
        raise ProcessGoneError(f"the simulator did not start: {message} (its output is in {log})") from error
    if "error" in answer.header:
        await Root(peer, process, 0.0).end()
        raise ProcessGoneError(str(answer.header["error"]))
    return Root(peer, process, float(answer.header["memory_mb"]))


def _shorten(log: Path) -> None:
    """Empty a long output, which nothing else bounds."""
    if log.exists() and log.stat().st_size > LOG_BYTES:
        os.truncate(log, 0)


def _last_line(log: Path) -> str:
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LAST_BYTES))
        lines = file.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def describe_status(status: int) -> str:
    """Describe a wait status."""
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exited with status {os.WEXITSTATUS(status)}"
