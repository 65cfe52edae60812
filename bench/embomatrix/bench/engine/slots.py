"""Cost of a scene in the worker's own processes: loading it in a fork of the root, forking slots, private memory."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.values import Rollout
from embomatrix.sim.zygote import PipeMessage, private_mb
from embomatrix.worker.slots.processes import Child, ProcessGoneError, Root, start_root
from embomatrix.worker.slots.residents import SlotLimits

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import SceneWork

LOADS: Final = 3
"""Loads of each scene, each in a new process."""
RESPAWNS: Final = 8
WAIT_S: Final = 0.3
"""Time for a scene to complete its deferred work, as an announced scene has before its first rollout."""
ANSWER_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class SlotSample:
    """Single measurements in processes: CPU seconds of loads and rollouts, wall seconds of respawns, memory in MB."""

    load_s: list[float] = field(default_factory=list)
    execute_s: list[float] = field(default_factory=list)
    respawn_s: list[float] = field(default_factory=list)
    """Time from the order to kill a slot to the first answer of the next slot, which executed an empty plan."""
    private_mb: list[float] = field(default_factory=list)
    """Private memory of an idle slot that has executed every plan of its scene."""


def measure_slots(scenes: Sequence[tuple[SceneWork, bytes]]) -> SlotSample:
    """Load the scenes and execute their plans as a worker does. Raises BenchError if a process fails."""
    sample = SlotSample()
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as folder:
        try:
            asyncio.run(_measure(scenes, Path(folder), sample))
        except ProcessGoneError as error:
            raise BenchError(f"the simulator can't be measured: {error}") from error
    return sample


async def _measure(scenes: Sequence[tuple[SceneWork, bytes]], folder: Path, sample: SlotSample) -> None:
    root = await start_root(folder / "simulator.log")
    try:
        for number, (scene, data) in enumerate(scenes):
            path = folder / f"{number}.bundle"
            path.write_bytes(data)
            for _ in range(LOADS - 1):
                await (await _load(root, scene, path, sample)).end()
            child = await _load(root, scene, path, sample)
            await _execute(child, scene, sample)
            await child.end()
    finally:
        await root.end()


async def _load(root: Root, scene: SceneWork, path: Path, sample: SlotSample) -> Child:
    child = await root.fork()
    memory_mb = SlotLimits(1, 0).slot_memory_mb
    request = {
        "path": str(path),
        "digest": scene.bundle_digest,
        "slot_memory_mb": memory_mb,
        "scene_memory_mb": memory_mb,
        "sharing": False,
    }
    answer = await _ask(child, PipeMessage(request))
    sample.load_s.append(float(answer.header["cpu_s"]))
    return child


async def _execute(child: Child, scene: SceneWork, sample: SlotSample) -> None:
    await asyncio.sleep(WAIT_S)
    slot = await child.fork()
    for rollout in scene.rollouts:
        answer = await _ask(slot, _request(rollout))
        sample.execute_s.append(float(answer.header["cpu_s"]))
    await asyncio.sleep(WAIT_S)
    sample.private_mb.append(private_mb(slot.pid))
    empty = _request(Rollout("empty", "empty", scene.bundle_digest, scene.executions[0].task_id, (), 0))
    for _ in range(RESPAWNS):
        killed = slot
        started_s = time.perf_counter()
        killed.kill()
        slot = await child.fork()
        await _ask(slot, empty)
        sample.respawn_s.append(time.perf_counter() - started_s)
        await killed.end()
    await slot.end()


def _request(rollout: Rollout) -> PipeMessage:
    return PipeMessage({"op": "execute"}, rollout_to_proto(rollout).SerializeToString())


async def _ask(child: Child, request: PipeMessage) -> PipeMessage:
    async with asyncio.timeout(ANSWER_S):
        answer = await child.peer.ask(request)
    if "error" in answer.header:
        raise BenchError(f"the simulator failed: {answer.header['error']}")
    return answer
