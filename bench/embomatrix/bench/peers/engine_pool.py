"""What runs in the processes of the peers: our simulator, with scenes that stay loaded, or loaded anew for every rollout.

A process that holds scenes does what a slot of ours does: bodies are made ahead, the heap is frozen, garbage is collected
between rollouts. Plans and results travel as bytes, which is half the work of pickling them.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.hierarchy import score
from embomatrix.rpc.wire.outcome import completed_to_proto
from embomatrix.rpc.wire.rollout import rollout_from_proto
from embomatrix.rpc.wire.values import Completed, Timings
from embomatrix.sim.simulation import load_simulator
from embomatrix.worker.slots.physics import Physics
from embomatrix.worker.slots.slot_program import COLLECT_EVERY
from embomatrix.world.bundle import read_bundle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.rpc.wire.values import Rollout
    from embomatrix.worker.slots.physics import PhysicsScene

    Answer = tuple[int, int, list[bytes]]
    """The process id, how many scenes had to be loaded, and the results."""

EXECUTED: Final = "executed.log"
GREETING_S: Final = 0.05
"""A request without rollouts takes this long, so that the next one finds another process."""


def write_bundles(folder: Path, bundles: Mapping[str, bytes]) -> None:
    """Lay bundles where the processes look for them."""
    for digest, data in bundles.items():
        (folder / _file(digest)).write_bytes(data)


def forget_executions(folder: Path) -> None:
    """Count anew."""
    (folder / EXECUTED).unlink(missing_ok=True)


def executed_twice(folder: Path) -> int:
    """How many executions began for rollouts that had been begun before."""
    path = folder / EXECUTED
    begun = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return len(begun) - len(set(begun))


def execute_fresh(folder: str, request: bytes) -> bytes:
    """Load the scene, execute and score the plan, and forget the scene."""
    rollout = rollout_from_proto(types_pb2.Rollout.FromString(request))
    _note(folder, rollout)
    bundle = read_bundle(Path(folder) / _file(rollout.bundle_digest), digest=rollout.bundle_digest)
    task = bundle.tasks[rollout.task_id]
    with contextlib.closing(load_simulator(bundle)) as simulator:
        trace = simulator.execute(task, rollout.plan, rollout.seed)
        reward = score(task, trace.touched, simulator.facts)
    completed = Completed(
        reward=reward,
        steps=trace.steps,
        final=trace.final,
        trace_digest=trace.digest,
        worker_id="",
        timings=Timings(),
        warm=False,
    )
    return completed_to_proto(completed).SerializeToString()


def execute_held(folder: str, digests: Sequence[str], requests: Sequence[bytes]) -> Answer:
    """Execute in the scenes that this process holds; ``digests`` are loaded when it is first asked."""
    return _holder(folder, tuple(digests)).answer(requests)


@functools.cache
def _holder(folder: str, digests: tuple[str, ...]) -> SceneProcess:
    return SceneProcess(folder, digests)


class SceneProcess:
    """The scenes of one process."""

    def __init__(self, folder: str, digests: Sequence[str]) -> None:
        """Load the scenes of these bundles ahead."""
        self._folder = folder
        self._physics = Physics()
        self._physics.prepare()
        self._scenes: dict[str, PhysicsScene] = {}
        self._executed = 0
        for digest in digests:
            for _ in self._load(digest).complete():
                pass
        gc.collect()
        gc.freeze()
        gc.disable()

    def answer(self, requests: Sequence[bytes]) -> Answer:
        """Execute rollouts one after another."""
        before = len(self._scenes)
        results = [self._execute(rollout_from_proto(types_pb2.Rollout.FromString(data))) for data in requests]
        if not requests:
            time.sleep(GREETING_S)
        return os.getpid(), len(self._scenes) - before, results

    def _execute(self, rollout: Rollout) -> bytes:
        _note(self._folder, rollout)
        self._executed += 1
        if self._executed % COLLECT_EVERY == 0:
            gc.collect()
        scene = self._scenes.get(rollout.bundle_digest) or self._load(rollout.bundle_digest)
        return completed_to_proto(scene.execute(rollout)).SerializeToString()

    def _load(self, digest: str) -> PhysicsScene:
        scene = self._physics.load(Path(self._folder) / _file(digest), digest)
        self._scenes[digest] = scene
        return scene


def _note(folder: str, rollout: Rollout) -> None:
    """Say that an execution begins: one short line is written whole, whoever else writes."""
    log = os.open(f"{folder}/{EXECUTED}", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(log, f"{rollout.rollout_id}\n".encode())
    finally:
        os.close(log)


def _file(digest: str) -> str:
    return f"{digest.replace(':', '-')}.bundle"
