"""Zygotes: processes that fork ready children on request, and the frames of their protocol.

A zygote has one thread and loads everything before the first request: a fork starts within a millisecond and shares its
memory. A requester passes the child's end of a socket pair, talks to the child directly and sees its death as the end of the
stream.
"""

import contextlib
import ctypes
import gc
import json
import os
import resource
import select
import socket
import struct
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from embomatrix.host.limits import MIB
from embomatrix.host.parent import die_with_parent

_PREFIX: Final = struct.Struct("!II")
_written: Final = json.JSONEncoder(separators=(",", ":")).encode
PREFIX_BYTES: Final = _PREFIX.size
MAX_FRAME_BYTES: Final = 64 * 1024 * 1024
STATM_BYTES: Final = 256
"""Buffer for Linux's ``statm``: seven numbers and spare room."""
_PR_SET_THP_DISABLE: Final = 41


class FrameError(Exception):
    """Bytes that are not a frame of this protocol."""


@dataclass(frozen=True, slots=True)
class PipeMessage:
    """Message between processes: a JSON header and a body that the header describes."""

    header: Mapping[str, Any]
    body: bytes = b""
    fds: tuple[int, ...] = field(default=(), compare=False)
    """File descriptors sent along; the receiver owns them."""


def pack(frame: PipeMessage) -> bytes:
    """Encode a frame as two lengths, header and body. File descriptors travel beside its first byte."""
    header = _written(frame.header).encode()
    return _PREFIX.pack(len(header), len(frame.body)) + header + frame.body


def frame_lengths(prefix: bytes) -> tuple[int, int]:
    """Lengths of header and body from a prefix. Raises FrameError above 64 MiB."""
    header_bytes, body_bytes = _PREFIX.unpack(prefix)
    if header_bytes + body_bytes > MAX_FRAME_BYTES:
        raise FrameError(f"a frame of {header_bytes + body_bytes} bytes: at most {MAX_FRAME_BYTES} are taken")
    return header_bytes, body_bytes


def unpack(content: bytes, header_bytes: int, fds: tuple[int, ...] = ()) -> PipeMessage:
    """Decode a frame; the first ``header_bytes`` of the content are its header."""
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
    """Receive the next frame with its descriptors, blocking; None at the end of the stream."""
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
    """Fork children on request until the control stream ends; take steps of ``spare`` while idle.

    ``{"op": "fork"}`` with one descriptor forks a child that runs ``child`` on it; the answer is its process id. ``{"op":
    "reap", "pid": …}`` waits for an ended child; the answer is its wait status. A child stays a zombie until it is reaped, so
    the requester never kills another process with a reused id.
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
    # Freeze existing objects: a collection in a child would copy their memory pages.
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
    """Disable huge pages for further allocations: a huge page becomes private with its first write.

    Huge pages shared with the parent stay as they are.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0)


def limit_memory(more_mb: int) -> None:
    """Limit further memory mappings of this process to ``more_mb`` MiB; beyond it, allocation fails."""
    mapped_pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = mapped_pages * resource.getpagesize() + more_mb * MIB
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


@contextlib.contextmanager
def memory_limited(more_mb: int) -> Iterator[None]:
    """Limit further memory mappings of this process to ``more_mb`` MiB while the context is held."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    mapped_pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = mapped_pages * resource.getpagesize() + more_mb * MIB
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def give_back_memory() -> None:
    """Return free heap pages to the system, so that a peak does not count as the slot's memory permanently."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # GNU C library only
    if trim is not None:
        trim(0)


def resident_mb() -> float:
    """Resident memory of this process in MiB, shared pages included."""
    # Called after every rollout: os.read takes a fifth of the time of a file object.
    statm = os.open("/proc/self/statm", os.O_RDONLY)
    try:
        pages = int(os.read(statm, STATM_BYTES).split()[1])
    finally:
        os.close(statm)
    return pages * resource.getpagesize() / MIB


def private_mb(pid: int | None = None) -> float:
    """Private memory of this process, or of the given one, in MiB: the amount that its end frees."""
    total_kb = 0
    for line in Path(f"/proc/{pid or 'self'}/smaps_rollup").read_text().splitlines():
        if line.startswith(("Private_Dirty:", "Private_Clean:")):
            total_kb += int(line.split()[1])
    return total_kb / 1024
