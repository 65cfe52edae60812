"""Owner watch: a worker pauses for its owner, hands leases back, keeps its scenes, and resumes."""

import asyncio
import contextlib
import functools

import numpy as np
from tests.fakes import waiting
from tests.fakes.manager import FakeManager, serving
from tests.fakes.simulation import PROGRAM

from embomatrix.rpc.wire.values import ResidentState, Resources
from embomatrix.worker.host.owner_policy import Observation, Preferences
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon
from embomatrix.worker.link.status import running_daemons

AWAY = Observation(0, owner_idle_s=1000.0)
THERE = Observation(0, owner_idle_s=0.0)
SCARCE = Observation(0, owner_idle_s=0.0, free_memory=0.02)


class Room:
    """Probe of a machine whose owner the test plays."""

    def __init__(self):
        self.seen = AWAY

    def observe(self):
        return self.seen


@contextlib.asynccontextmanager
async def lent(manager, folder, *, slots=1, grace_s=30.0):
    """Run a daemon that works while its owner is away."""
    room = Room()
    chosen = Preferences(idle_s=60, grace_s=grace_s, calm_s=0.05, check_s=0.02)
    async with serving(manager) as address:
        settings = WorkerSettings(
            manager=address, name="w1", cache_dir=folder, state_dir=folder, preferences=chosen
        )
        rng = np.random.default_rng(0)
        daemon = Daemon(settings, Resources(slots, slots, 500), rng, program=PROGRAM, probe=room)
        task = asyncio.create_task(daemon.run())
        try:
            await _until(lambda: manager.states)
            yield room
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


_until = functools.partial(waiting.until, limit_s=15.0)


def _done(manager):
    return [result.ref.lease_id for result in manager.results]


def _held(manager):
    return [ref.lease_id for ref in manager.states[-1].running]


async def test_pause_finishes_running_leases_and_hands_waiting_ones_back(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with lent(manager, tmp_path) as room:
        manager.lease("l1", digest, "slow")
        manager.lease("l2", digest)
        await _until(lambda: ["l1", "l2"] in manager.renewed)
        room.seen = THERE
        await _until(lambda: manager.states[-1].paused == "its owner is active")
        await _until(lambda: "l1" in _done(manager) and "l2" not in _held(manager))
        manager.lease("l3", digest)
        await _until(lambda: "l3" not in _held(manager) and manager.states[-1].paused)
        assert _done(manager) == ["l1"]
        room.seen = AWAY
        await _until(lambda: not manager.states[-1].paused)
        manager.lease("l4", digest)
        await _until(lambda: "l4" in _done(manager))
    assert _done(manager) == ["l1", "l4"]
    assert len(manager.registrations) == 1


async def test_leases_beyond_the_grace_period_are_handed_back(tmp_path):
    manager = FakeManager()
    async with lent(manager, tmp_path, grace_s=0.2) as room:
        manager.lease("l1", manager.bundle(b"ok"), "hang", deadline_s=600.0)
        await _until(lambda: ["l1"] in manager.renewed)
        reported = len(manager.states)
        room.seen = THERE
        await _until(lambda: len(manager.states) >= reported + 2 and not _held(manager))
        await _until(lambda: manager.renewed[-1] == [])
    assert manager.results == []


async def test_scenes_stay_through_a_pause_until_memory_is_scarce(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with lent(manager, tmp_path) as room:
        manager.want(digest)
        await _until(lambda: any(r.state is ResidentState.WARM for r in manager.states[-1].residents))
        room.seen = THERE
        await _until(lambda: manager.states[-1].paused)
        assert [r.bundle_digest for r in manager.states[-1].residents] == [digest]
        room.seen = SCARCE
        await _until(lambda: not manager.states[-1].residents)
        room.seen = AWAY
        await _until(lambda: any(r.state is ResidentState.WARM for r in manager.states[-1].residents))
    assert manager.fetches == [digest]


async def test_nothing_is_loaded_during_a_pause(tmp_path):
    manager = FakeManager()
    async with lent(manager, tmp_path) as room:
        room.seen = THERE
        await _until(lambda: manager.states[-1].paused)
        manager.want(manager.bundle(b"ok"))
        await asyncio.sleep(0.2)
        assert manager.fetches == []


async def test_pause_is_reported_again_on_a_new_session(tmp_path):
    manager = FakeManager()
    async with lent(manager, tmp_path) as room:
        room.seen = THERE
        await _until(lambda: manager.states[-1].paused)
        manager.forget_session()
        await _until(lambda: len(manager.registrations) == 2)
        await _until(lambda: manager.states[-1].paused == "its owner is active")


async def test_status_file_shows_pause_and_connection_and_is_removed_with_the_daemon(tmp_path):
    manager = FakeManager()
    async with lent(manager, tmp_path) as room:
        await _until(lambda: any(status.connected_since_s for status in running_daemons(tmp_path)))
        room.seen = THERE
        await _until(lambda: running_daemons(tmp_path)[0].paused == "its owner is active")
        assert running_daemons(tmp_path)[0].slots == 1
    assert running_daemons(tmp_path) == []
