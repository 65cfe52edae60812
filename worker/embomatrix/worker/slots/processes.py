"""The daemon's view of the simulator's processes: start the root, have children forked, ask them, end them."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
import socket
import sys
from typing import TYPE_CHECKING, Final

from embomatrix.sim.zygote import PREFIX_BYTES, PipeMessage, frame_lengths, pack, unpack

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from embomatrix.worker.slots.progress import ProgressBoard

SIMULATOR_PROGRAM: Final = (sys.executable, "-m", "embomatrix.worker.slots.physics")
START_S: Final = 60.0
"""Limit for a root to import the engine, on a machine that is busy."""
ENVIRONMENT: Final = {
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Huge pages halve the time of a fork; the C library reads this before the first line of Python runs."""
FORK_S: Final = 10.0
REAP_S: Final = 5.0
READ_BYTES: Final = 64 * 1024
"""Taken from a process's stream at once: more than most answers have."""


class ProcessGoneError(Exception):
    """The process at the other end has died."""


class ProcessChannel:
    """Asks one process, one question at a time. Made and used on one event loop, which it stays registered with."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._connection = connection
        self._turn = asyncio.Lock()
        self._heard = bytearray()
        self._gone = ""
        self._listener: asyncio.Future[None] | None = None
        self._listening = False
        self._listen()

    async def ask(self, frame: PipeMessage) -> PipeMessage:
        """Send the frame with its descriptors and wait for the answer. Raises ProcessGoneError.

        After a cancelled question the stream is out of step: the process must be ended.
        """
        async with self._turn:
            try:
                await self._send(frame)
            except OSError as error:
                raise ProcessGoneError(str(error)) from error
            return await self.hear()

    async def hear(self) -> PipeMessage:
        """The next frame that comes unasked."""
        header_bytes, body_bytes = frame_lengths(await self._take(PREFIX_BYTES))
        return unpack(await self._take(header_bytes + body_bytes), header_bytes)

    async def post(self, frames: Iterable[PipeMessage]) -> None:
        """Send questions whose answers are ``gathered``, in one write. Raises ProcessGoneError."""
        try:
            await self._send_all(b"".join(map(pack, frames)))
        except OSError as error:
            raise ProcessGoneError(str(error)) from error

    async def gathered(self, pause_s: float) -> list[PipeMessage]:
        """All that came when the pause is over: none perhaps; without a pause, one frame at least is waited for.

        Raises ProcessGoneError when nothing came and nothing can come.
        """
        if pause_s > 0:
            # Not listened to meanwhile: each answer would wake this process for itself.
            self._listen_no_more()
            await asyncio.sleep(pause_s)
            return self.arrived()
        # However fast the process answers, others have their turn between two answers.
        await asyncio.sleep(0)
        while not (frames := self.arrived()):
            self._listen()
            await self._news()
        return frames

    def arrived(self) -> list[PipeMessage]:
        """All whole frames that have come. Raises ProcessGoneError when there is none and the stream has ended."""
        while not self._gone and self._receive() == READ_BYTES:
            pass
        frames, at = [], 0
        while len(self._heard) - at >= PREFIX_BYTES:
            begin = at + PREFIX_BYTES
            header_bytes, body_bytes = frame_lengths(bytes(self._heard[at:begin]))
            end = begin + header_bytes + body_bytes
            if end > len(self._heard):
                break
            frames.append(unpack(bytes(self._heard[begin:end]), header_bytes))
            at = end
        del self._heard[:at]
        if self._gone and not frames:
            raise ProcessGoneError(self._gone)
        return frames

    def close(self) -> None:
        """Close the stream. Whoever still waits for an answer on it must be cancelled."""
        if self._connection.fileno() >= 0:
            # Left behind, these would hear what comes on the next socket that is given this one's number.
            self._listen_no_more()
            asyncio.get_running_loop().remove_writer(self._connection)
        self._connection.close()

    def _listen(self) -> None:
        """For good, not for each answer: taking it out and in again costs more than the answer itself."""
        if not self._listening and not self._gone:
            asyncio.get_running_loop().add_reader(self._connection, self._readable)
            self._listening = True

    def _listen_no_more(self) -> None:
        if self._listening:
            asyncio.get_running_loop().remove_reader(self._connection)
            self._listening = False

    async def _send(self, frame: PipeMessage) -> None:
        data = pack(frame)
        # A question finds the buffer empty: all but the largest are taken at once. Descriptors go with the first byte.
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
        """The next so many bytes, waited for. Raises ProcessGoneError when the stream ends before."""
        while len(self._heard) < count:
            if self._gone:
                raise ProcessGoneError(self._gone)
            self._listen()
            await self._news()
        taken = bytes(memoryview(self._heard)[:count])
        del self._heard[:count]
        return taken

    async def _news(self) -> None:
        """Wait until more was heard, or the stream ended."""
        self._listener = asyncio.get_running_loop().create_future()
        try:
            await self._listener
        finally:
            self._listener = None

    def _readable(self) -> None:
        self._receive()
        if self._listener is not None and not self._listener.done():
            self._listener.set_result(None)

    def _receive(self) -> int:
        """Take what is there, up to a limit; tells how many bytes."""
        try:
            part = self._connection.recv(READ_BYTES)
            self._gone = "" if part else "its stream ended"
        except BlockingIOError:
            return 0
        except OSError as error:
            part, self._gone = b"", str(error)
        self._heard += part
        if self._gone:
            self._listen_no_more()
        return len(part)


class Zygote:
    """A process that forks children: the root, or one that holds a scene."""

    def __init__(self, peer: ProcessChannel) -> None:
        self.peer = peer
        self._questions: set[asyncio.Task[PipeMessage]] = set()

    async def fork(self, limit_s: float = FORK_S) -> Child:
        """Have a child forked and speak to it. Raises ProcessGoneError when the zygote has died or does not answer."""
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                answer = await self._ask(PipeMessage({"op": "fork"}, fds=(os.dup(theirs.fileno()),)), limit_s)
        except BaseException:
            ours.close()
            raise
        return Child(self, ProcessChannel(ours), int(answer.header["pid"]))

    async def reap(self, pid: int) -> str:
        """Collect a child that has ended and say how."""
        answer = await self._ask(PipeMessage({"op": "reap", "pid": pid}), REAP_S)
        return describe_status(int(answer.header["status"]))

    def close(self) -> None:
        """Close the stream to a process that is given up: what was asked of it is never answered."""
        for question in self._questions:
            question.cancel()
        self.peer.close()

    async def _ask(self, frame: PipeMessage, limit_s: float) -> PipeMessage:
        """Ask to the end even when the caller is cancelled: other slots depend on this stream staying in step."""
        question = asyncio.create_task(self.peer.ask(frame))
        self._questions.add(question)
        question.add_done_callback(functools.partial(self._answered, frame))
        try:
            async with asyncio.timeout(limit_s):
                # Not awaited itself: when the process is given up, that cancels the question and not the asker.
                await asyncio.wait((question,))
        except TimeoutError as error:
            raise ProcessGoneError(f"it did not answer within {limit_s:g} s") from error
        if question.cancelled():
            raise ProcessGoneError("it was ended")
        return question.result()

    def _answered(self, frame: PipeMessage, question: asyncio.Task[PipeMessage]) -> None:
        self._questions.discard(question)
        for fd in frame.fds:
            os.close(fd)
        if not question.cancelled():
            question.exception()  # nobody may be left to look at it


class Child(Zygote):
    """A forked process: it answers, and it may fork children of its own."""

    def __init__(self, parent: Zygote, peer: ProcessChannel, pid: int) -> None:
        super().__init__(peer)
        self.pid = pid
        self._parent = parent

    def kill(self) -> None:
        """Have the process die, whatever it does. It must be ended later, or its id is never free again."""
        self.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    async def end(self) -> str:
        """Kill the process and say how it ended; one that had died before keeps its own reason."""
        self.kill()
        try:
            return await self._parent.reap(self.pid)
        except ProcessGoneError:
            return "died with the process that it was forked from"


class Root(Zygote):
    """The process that imported the engine, spawned afresh: nothing of the daemon's threads or locks is in it."""

    def __init__(self, peer: ProcessChannel, process: asyncio.subprocess.Process, memory_mb: float) -> None:
        super().__init__(peer)
        self.memory_mb = memory_mb
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    async def end(self) -> None:
        """Kill it; its children die with it."""
        self.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        await self._process.wait()


async def start_root(
    log: Path, program: tuple[str, ...] = SIMULATOR_PROGRAM, board: ProgressBoard | None = None
) -> Root:
    """Spawn the root and wait until it has imported the engine. Raises ProcessGoneError with the reason.

    Its slots tell on the ``board`` how far they are; without one they tell nobody.
    What the engine prints goes to ``log``: Bullet writes warnings to standard output.
    """
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
            # Ctrl-C reaches every process of the terminal's group: the simulator must outlive a drain.
            start_new_session=True,
        )
    peer = ProcessChannel(ours)
    try:
        async with asyncio.timeout(START_S):
            answer = await peer.hear()
    except (ProcessGoneError, TimeoutError, OSError) as error:
        await Root(peer, process, 0.0).end()
        said = (await asyncio.to_thread(_last_line, log)) or str(error)
        raise ProcessGoneError(f"the simulator did not start: {said} (its output is in {log})") from error
    if "error" in answer.header:
        await Root(peer, process, 0.0).end()
        raise ProcessGoneError(str(answer.header["error"]))
    return Root(peer, process, float(answer.header["memory_mb"]))


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def describe_status(status: int) -> str:
    """A wait status in words."""
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exited with status {os.WEXITSTATUS(status)}"
