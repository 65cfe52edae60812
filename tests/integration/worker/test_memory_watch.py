"""Memory watch: scenes are evicted while other programs need the memory, and loaded again afterwards."""

import asyncio
import contextlib

import numpy as np
import psutil
from tests.fakes.manager import FakeManager, serving
from tests.fakes.real_cluster import until
from tests.fakes.simulation import PROGRAM
from tests.integration.worker.test_slots import running

from embomatrix.host.limits import MIB
from embomatrix.rpc.wire.values import Completed, ResidentState, Resources
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon
from embomatrix.worker.slots import yielding
from embomatrix.worker.slots.yielding import SCARCE_MEMORY, MemoryWatch, spare_memory_mb

SCENES = ["ok-1", "ok-2", "ok-3"]


class Machine:
    def __init__(self):
        self.spare_mb = 1000.0


@contextlib.asynccontextmanager
async def watched(folder):
    """Yield a pool with warm scenes, and the machine that limits its memory."""
    machine = Machine()
    async with running(folder) as harness:
        watch = asyncio.create_task(MemoryWatch(harness.pool, lambda: machine.spare_mb).run(0.02))
        try:
            harness.pool.want(SCENES)
            await harness.until(lambda: warm(harness) == SCENES)
            yield harness, machine
        finally:
            watch.cancel()


def warm(harness):
    residents = harness.pool.residents()
    return sorted(r.bundle_digest for r in residents if r.state is ResidentState.WARM)


async def test_scenes_are_evicted_while_memory_is_scarce_and_loaded_again_after(tmp_path):
    async with watched(tmp_path) as (harness, machine):
        machine.spare_mb = -1e6
        await harness.until(lambda: warm(harness) == SCENES[:1])
        assert len(harness.pool.residents()) == 1  # the most urgent one
        machine.spare_mb = 1000.0
        await harness.until(lambda: warm(harness) == SCENES)


async def test_leases_are_executed_however_little_memory_there_is(tmp_path):
    async with watched(tmp_path) as (harness, machine):
        machine.spare_mb = -1e6
        await harness.until(lambda: len(harness.pool.residents()) == 1)
        for number, scene in enumerate(SCENES):
            harness.submit(f"l{number}", digest=scene)
        outcomes = await harness.outcomes(len(SCENES))
        assert all(isinstance(outcome, Completed) for outcome in outcomes.values())


async def test_memory_limit_never_exceeds_the_configured_one(tmp_path):
    # Each takes 40 MB plus its private memory.
    async with running(tmp_path, memory_mb=75.0) as harness:
        harness.pool.limit_memory(1e6)
        harness.pool.want(["large-1", "large-2", "large-3"])
        # The memory of a scene is known after its first load. One that does not fit is then evicted.
        await harness.until(lambda: len(harness.pool.residents()) == len(warm(harness)) == 1)
        assert harness.pool.memory_used_mb <= 75.0


async def test_daemon_watches_memory_from_its_start(tmp_path, monkeypatch):
    machine = Machine()
    monkeypatch.setattr(yielding, "spare_memory_mb", lambda: machine.spare_mb)
    manager = FakeManager()
    async with serving(manager) as address:
        settings = WorkerSettings(manager=address, name="w1", cache_dir=tmp_path, state_dir=tmp_path)
        daemon = Daemon(settings, Resources(1, 1, 500), np.random.default_rng(0), program=PROGRAM)
        task = asyncio.create_task(daemon.run())
        try:
            await until(lambda: manager.states)
            manager.want(manager.bundle(b"ok"), manager.bundle(b"ok "))
            await until(lambda: len(manager.states[-1].residents) == 2)
            machine.spare_mb = -1e6
            await until(lambda: len(manager.states[-1].residents) == 1)
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def test_spare_memory_leaves_a_tenth_of_the_machine():
    memory = psutil.virtual_memory()
    at_most = (1 - SCARCE_MEMORY) * memory.total / MIB
    assert spare_memory_mb() <= at_most
    assert spare_memory_mb() < memory.available / MIB
