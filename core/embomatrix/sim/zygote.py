"""Processes that fork ready children on request, and the frames they are spoken to in.

A zygote has one thread and loaded everything before it is asked for the first child: a fork of it starts within a
millisecond and shares its memory. Whoever asks passes the child's own end of a socket pair along, so it speaks to the
child directly and learns of its death by the end of that stream.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import resource
import select
import socket
import struct
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from embomatrix.host.cgroup import MIB
from embomatrix.host.parent import die_with_parent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

_PREFIX: Final = struct.Struct("!II")
_written: Final = json.JSONEncoder(separators=(",", ":")).encode
PREFIX_BYTES: Final = _PREFIX.size
MAX_FRAME_BYTES: Final = 64 * 1024 * 1024
STATM_BYTES: Final = 256
"""More than the seven numbers of Linux's ``statm`` take."""
_PR_SET_THP_DISABLE: Final = 41


class FrameError(Exception):
    """Bytes that are no frame: the other side is not what it should be."""


@dataclass(frozen=True, slots=True)
class PipeMessage:
    """One message between processes: a JSON header, and bytes that the header says how to read."""

    header: Mapping[str, Any]
    body: bytes = b""
    fds: tuple[int, ...] = field(default=(), compare=False)
    """File descriptors that came along; the receiver owns them."""


def pack(frame: PipeMessage) -> bytes:
    """The frame as bytes: two lengths, header, body. File descriptors travel beside it, with its first byte."""
    header = _written(frame.header).encode()
    return _PREFIX.pack(len(header), len(frame.body)) + header + frame.body


def frame_lengths(prefix: bytes) -> tuple[int, int]:
    """Lengths of header and body that a prefix announces; more than 64 MiB is a ``FrameError``."""
    header_bytes, body_bytes = _PREFIX.unpack(prefix)
    if header_bytes + body_bytes > MAX_FRAME_BYTES:
        raise FrameError(f"a frame of {header_bytes + body_bytes} bytes: at most {MAX_FRAME_BYTES} are taken")
    return header_bytes, body_bytes


def unpack(content: bytes, header_bytes: int, fds: tuple[int, ...] = ()) -> PipeMessage:
    """The frame whose header is the first ``header_bytes`` of the content."""
    try:
        header = json.loads(content[:header_bytes])
    except ValueError as error:
        raise FrameError(f"the header of a frame is no JSON: {error}") from error
    if not isinstance(header, dict):
        raise FrameError(f"the header of a frame is a {type(header).__name__}: it must be an object")
    return PipeMessage(header, content[header_bytes:], fds)


def send(connection: socket.socket, frame: PipeMessage) -> None:
    """Send a frame, blocking."""
    connection.sendall(pack(frame))


def receive(connection: socket.socket) -> PipeMessage | None:
    """The next frame, blocking, with the descriptors that came with it; None at the end of the stream."""
    prefix, fds, _, _ = socket.recv_fds(connection, PREFIX_BYTES, 4)
    if not prefix:
        return None
    prefix += _receive_exactly(connection, PREFIX_BYTES - len(prefix))
    header_bytes, body_bytes = frame_lengths(prefix)
    return unpack(_receive_exactly(connection, header_bytes + body_bytes), header_bytes, tuple(fds))


def _receive_exactly(connection: socket.socket, count: int) -> bytes:
    parts = bytearray()
    while len(parts) < count:
        part = connection.recv(count - len(parts))
        if not part:
            raise FrameError(f"the stream ended within a frame: {count - len(parts)} bytes are missing")
        parts += part
    return bytes(parts)


def serve_forks(
    control: socket.socket, child: Callable[[socket.socket], None], spare: Iterator[None] | None = None
) -> None:
    """Fork children on request until the control stream ends. Steps of ``spare`` are taken while no request waits.

    ``{"op": "fork"}`` with one descriptor forks a child that runs ``child`` on it and is answered by its process id;
    ``{"op": "reap", "pid": …}`` waits for a child that has ended and is answered by its wait status. A child stays a
    zombie until then, so its id is never another process's when the asker kills it.
    """
    while (request := _next_request(control, spare)) is not None:
        match request.header.get("op"):
            case "fork" if len(request.fds) == 1:
                send(control, PipeMessage({"pid": _fork(control, request.fds[0], child)}))
            case "reap":
                _, status = os.waitpid(int(request.header["pid"]), 0)
                send(control, PipeMessage({"status": status}))
            case unknown:
                raise FrameError(f"a zygote can't {unknown!r}: it takes fork (with a descriptor) and reap")


def _next_request(control: socket.socket, spare: Iterator[None] | None) -> PipeMessage | None:
    if spare is not None:
        while not select.select([control], [], [], 0)[0]:
            try:
                next(spare)
            except StopIteration:
                break
    return receive(control)


def _fork(control: socket.socket, fd: int, child: Callable[[socket.socket], None]) -> int:
    # Objects that exist now are never collected: a collection in a child would copy the pages they lie in.
    gc.freeze()
    parent = os.getpid()
    pid = os.fork()
    if pid:
        os.close(fd)
        return pid
    status = 1
    try:
        control.close()
        die_with_parent(parent)
        child(socket.socket(fileno=fd))
        status = 0
    except BaseException:  # noqa: BLE001  # whatever it is, it must not climb into the parent's frames
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(status)


def take_small_pages() -> None:
    """Have what this process allocates from now on come in pages of 4 kB: a huge one would be its own for the first byte.

    Huge pages that it shares with the process that it was forked from stay as they are.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0)


def limit_memory(more_mb: int) -> None:
    """Let this process map at most ``more_mb`` MiB beyond what it has: past that, allocation fails."""
    mapped_pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = mapped_pages * resource.getpagesize() + more_mb * MIB
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def give_back_memory() -> None:
    """Hand the heap's free pages back to the system: what a slot needed once shall not count as its own for good."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # the GNU C library has it
    if trim is not None:
        trim(0)


def resident_mb() -> float:
    """Memory of this process that lies in RAM, shared pages included, in MiB."""
    # Asked after every rollout: through a file object it takes five times as long.
    statm = os.open("/proc/self/statm", os.O_RDONLY)
    try:
        pages = int(os.read(statm, STATM_BYTES).split()[1])
    finally:
        os.close(statm)
    return pages * resource.getpagesize() / MIB


def private_mb(pid: int | None = None) -> float:
    """Memory that only this process, or the one of that id, holds, in MiB: what its end would free."""
    total_kb = 0
    for line in Path(f"/proc/{pid or 'self'}/smaps_rollup").read_text().splitlines():
        if line.startswith(("Private_Dirty:", "Private_Clean:")):
            total_kb += int(line.split()[1])
    return total_kb / 1024
