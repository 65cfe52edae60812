"""Program of the simulator's processes: a root that imported the engine, forks of it that hold one scene each, and forks of
those, the slots, that execute rollouts.

``embomatrix.worker.slots.physics`` runs it with the real engine. It imports nothing that starts threads, such as gRPC: a thread
does not survive a fork, but the locks that it held do.
"""

from __future__ import annotations

import functools
import gc
import itertools
import mmap
import os
import select
import signal
import socket
import struct
import sys
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Protocol

from embomatrix.host.anonymous_memory import nameless_file
from embomatrix.host.parent import die_with_parent
from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.outcome import completed_to_proto
from embomatrix.rpc.wire.rollout import rollout_from_proto
from embomatrix.rpc.wire.values import Completed, InfraCode, Rollout
from embomatrix.sim.zygote import (
    PipeMessage,
    give_back_memory,
    limit_memory,
    memory_limited,
    private_mb,
    receive,
    resident_mb,
    send,
    serve_forks,
    take_small_pages,
)
from embomatrix.skills.turns import PrefixMismatchError

MAX_ERROR_CHARS: Final = 500
IDLE_S: Final = 0.1
"""A slot that is idle this long returns free memory to the system, which takes some milliseconds."""
COLLECT_EVERY: Final = 32
"""Rollouts between two garbage collections of a busy slot's new objects."""
COLLECT_ALL_EVERY: Final = 2_048
"""Rollouts between two collections of all its objects, which take 10 to 50 ms if its tree of transitions is full."""
SOUND: Final = "sound"
"""Key in the header of an error after which the process executes further rollouts."""
_COUNTER: Final = struct.Struct("=Q")


class LoadedScene(Protocol):
    """Scene in memory that executes plans. No result depends on the rollouts before."""

    def execute(self, rollout: Rollout, on_step: Callable[[int], None], reward: RewardSettings) -> Completed:
        """Execute the plan and score it; ``on_step`` gets the number of finished steps after each step."""

    def complete(self) -> Iterator[None]:
        """Complete deferred work in steps of a millisecond or two; it only makes later executions faster."""


class SimulationBackend(Protocol):
    """Source of scenes: the physics engine, or a stand-in of a test."""

    def prepare(self) -> None:
        """Import and connect everything that scenes share, before the first fork."""

    def load(self, path: Path, digest: str, *, sharing: bool) -> LoadedScene:
        """Load the bundle in this file. With ``sharing``, a slot executes the calls that plans have in common once.

        Raise BundleCorruptError if the content does not match the digest.
        """


class BundleCorruptError(Exception):
    """Bundle with damaged content that must be fetched again."""


class ProgressBoard:
    """Counters of finished steps of the slots 1 to ``slots``, in memory that the daemon shares with its simulator.

    Counting a step writes eight bytes: no message, no system call, no wake-up of the daemon. Counter 0 belongs to no slot.
    """

    def __init__(self, fd: int) -> None:
        """Map the board behind the descriptor, which stays open for inheritance until the board is collected."""
        self.fd = fd
        weakref.finalize(self, os.close, fd)
        self._memory = mmap.mmap(fd, os.fstat(fd).st_size)

    @classmethod
    def create(cls, slots: int) -> ProgressBoard:
        """Create a board, in memory only where the system supports that."""
        return cls(nameless_file("progress", (slots + 1) * _COUNTER.size))

    def set(self, slot: int, steps: int) -> None:
        _COUNTER.pack_into(self._memory, slot * _COUNTER.size, steps)

    def steps(self, slot: int) -> int:
        """Return the finished steps of the slot's rollout."""
        return int(_COUNTER.unpack_from(self._memory, slot * _COUNTER.size)[0])


def run_program(simulation: SimulationBackend) -> None:
    """Serve as root until the daemon ends.

    Arguments: the control socket's descriptor, the daemon's process id, and optionally the descriptor of a progress board.
    """
    die_with_parent(int(sys.argv[2]))
    # Ctrl-C is for the daemon: it drains first and then ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    control = socket.socket(fileno=int(sys.argv[1]))
    board = ProgressBoard(int(sys.argv[3])) if len(sys.argv) > 3 else ProgressBoard.create(0)
    try:
        simulation.prepare()
    except Exception as error:  # noqa: BLE001  # the daemon reports it
        send(control, PipeMessage(_failure(InfraCode.SCENE_LOAD_FAILED, error)))
        return
    send(control, PipeMessage({"memory_mb": private_mb()}))
    gc.collect()
    serve_forks(control, lambda connection: _hold_scene(simulation, connection, board))


def _hold_scene(simulation: SimulationBackend, connection: socket.socket, board: ProgressBoard) -> None:
    """Load the scene that the first frame names, then fork slots. This process executes no rollout and stays pristine."""
    request = receive(connection)
    if request is None:
        return
    # A scene is a hundred thousand objects without garbage: collections would take half of the loading time.
    gc.disable()
    core_s = time.thread_time()
    most_mb = int(request.header["scene_memory_mb"])
    try:
        with memory_limited(most_mb):
            path, sharing = Path(request.header["path"]), bool(request.header["sharing"])
            scene = simulation.load(path, request.header["digest"], sharing=sharing)
    except MemoryError:
        text = (
            f"the scene takes more than {most_mb} MB: give the worker more memory, or make the scene smaller"
        )
        send(connection, PipeMessage({"code": InfraCode.SCENE_LOAD_FAILED.value, "error": text}))
        return
    except BundleCorruptError as error:
        send(connection, PipeMessage(_failure(InfraCode.BUNDLE_CORRUPT, error)))
        return
    except Exception as error:  # noqa: BLE001  # a failure to load is a result
        send(connection, PipeMessage(_failure(InfraCode.SCENE_LOAD_FAILED, error)))
        return
    cpu_s = time.thread_time() - core_s
    send(connection, PipeMessage({"cpu_s": cpu_s, "memory_mb": private_mb()}))
    memory_mb = int(request.header["slot_memory_mb"])
    gc.enable()
    serve_forks(connection, lambda slot: _run_slot(scene, slot, memory_mb, board), scene.complete())


def _run_slot(scene: LoadedScene, connection: socket.socket, memory_mb: int, board: ProgressBoard) -> None:
    """Execute rollouts one after another, until the daemon closes the stream or one fails.

    More rollouts may wait in the stream. After an exception the state of this process is unknown, so it must not execute them,
    unless the exception is about the rollout.
    """
    limit_memory(memory_mb)
    take_small_pages()
    # A rollout leaves few reference cycles, so they are collected between rollouts only.
    gc.disable()
    for number in itertools.count(1):
        if number % COLLECT_EVERY == 0:
            gc.collect(2 if number % COLLECT_ALL_EVERY == 0 else 1)
        if not select.select([connection], [], [], IDLE_S)[0]:
            gc.collect()
            give_back_memory()
        request = receive(connection)
        if request is None:
            return
        on_step = functools.partial(board.set, int(request.header.get("slot", 0)))
        on_step(0)
        answer = _answer(scene, request, on_step)
        send(connection, answer)
        if "error" in answer.header and not answer.header.get(SOUND):
            return


def _answer(scene: LoadedScene, request: PipeMessage, on_step: Callable[[int], None]) -> PipeMessage:
    started_s, core_s = time.perf_counter(), time.thread_time()
    try:
        own = request.header.get("reward")
        reward = PAPER if own is None else RewardSettings(**own)
        rollout = rollout_from_proto(types_pb2.Rollout.FromString(request.body))
        completed = scene.execute(rollout, on_step, reward)
        result = completed_to_proto(completed).SerializeToString()
    except MemoryError as error:
        return PipeMessage(_failure(InfraCode.SLOT_OOM, error))
    except PrefixMismatchError as error:
        sentence = str(error)[:MAX_ERROR_CHARS]
        return PipeMessage({"code": InfraCode.PREFIX_MISMATCH.value, "error": sentence, SOUND: True})
    except Exception as error:  # noqa: BLE001  # a defect is an infrastructure failure, never a reward
        return PipeMessage(_failure(InfraCode.SLOT_CRASHED, error))
    header = {
        "execute_s": time.perf_counter() - started_s,
        "cpu_s": time.thread_time() - core_s,
        "resident_mb": resident_mb(),
    }
    return PipeMessage(header, result)


def _failure(code: InfraCode, error: Exception) -> Mapping[str, Any]:
    text = f"{type(error).__name__}: {error}"
    return {"code": code.value, "error": text[:MAX_ERROR_CHARS]}
