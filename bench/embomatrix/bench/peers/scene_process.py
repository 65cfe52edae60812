"""Code that runs in a peer's processes: our simulator, with scenes that stay loaded.

A process behaves like a slot: deferred work is completed ahead, the heap is frozen, and garbage is collected
between rollouts. Plans and results travel as protobuf bytes, which cost half as much as pickles.
"""

from __future__ import annotations

import functools
import gc
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from embomatrix.proto.v1 import types_pb2
from embomatrix.rpc.wire.outcome import completed_to_proto
from embomatrix.rpc.wire.rollout import rollout_from_proto
from embomatrix.rpc.wire.values import Rollout
from embomatrix.worker.slots.physics import Physics
from embomatrix.worker.slots.slot_program import COLLECT_EVERY

Answer = tuple[int, list[bytes]]
"""Process id and results."""

EXECUTED: Final = "executed.log"
GREETING_S: Final = 0.05
"""Duration of a request without rollouts, so that the next one reaches another process."""


def write_bundles(folder: Path, bundles: Mapping[str, bytes]) -> None:
    """Write bundles into the folder that the processes read."""
    for digest, data in bundles.items():
        (folder / _file(digest)).write_bytes(data)


def forget_executions(folder: Path) -> None:
    """Restart the count of executions."""
    (folder / EXECUTED).unlink(missing_ok=True)


def executed_twice(folder: Path) -> int:
    """Count executions of rollouts that had been begun before."""
    path = folder / EXECUTED
    begun = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return len(begun) - len(set(begun))


def execute_chunk(folder: str, digests: Sequence[str], requests: Sequence[bytes]) -> Answer:
    """Execute in the scenes of this process. The first call loads the scenes ``digests``."""
    return _scene_process(folder, tuple(digests)).execute(requests)


@functools.cache
def _scene_process(folder: str, digests: tuple[str, ...]) -> SceneProcess:
    return SceneProcess(folder, digests)


class SceneProcess:
    """Loaded scenes of one process."""

    def __init__(self, folder: str, digests: Sequence[str]) -> None:
        self._folder = folder
        physics = Physics()
        physics.prepare()
        paths = {digest: Path(folder) / _file(digest) for digest in digests}
        self._scenes = {digest: physics.load(path, digest, sharing=False) for digest, path in paths.items()}
        self._executed = 0
        for scene in self._scenes.values():
            for _ in scene.complete():
                pass
        gc.collect()
        gc.freeze()
        gc.disable()

    def execute(self, requests: Sequence[bytes]) -> Answer:
        """Execute rollouts one after another."""
        results = [self._execute(rollout_from_proto(types_pb2.Rollout.FromString(data))) for data in requests]
        if not requests:
            time.sleep(GREETING_S)
        return os.getpid(), results

    def _execute(self, rollout: Rollout) -> bytes:
        _log_execution(self._folder, rollout)
        self._executed += 1
        if self._executed % COLLECT_EVERY == 0:
            gc.collect()
        return completed_to_proto(self._scenes[rollout.bundle_digest].execute(rollout)).SerializeToString()


def _log_execution(folder: str, rollout: Rollout) -> None:
    """Append the rollout's id. Short appends are atomic across processes."""
    log = os.open(f"{folder}/{EXECUTED}", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(log, f"{rollout.rollout_id}\n".encode())
    finally:
        os.close(log)


def _file(digest: str) -> str:
    return f"{digest.replace(':', '-')}.bundle"
