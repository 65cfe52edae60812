"""Daemon against a fake manager: it keeps results until they are acknowledged and reconnects after every break."""

import asyncio
import contextlib
import functools
import re

import numpy as np
import pytest
from tests.fakes import waiting
from tests.fakes.manager import FakeManager, serving
from tests.fakes.simulation import PROGRAM

from embomatrix.rpc.status import ManagerUnreachableError, SupersededError
from embomatrix.rpc.wire.values import Completed, InfraCode, ResidentState, Resources
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link import session
from embomatrix.worker.link.daemon import Daemon


def _daemon(address, folder, **options):
    settings = WorkerSettings(manager=address, name="w1", cache_dir=folder, state_dir=folder, **options)
    return Daemon(settings, Resources(2, 2, 500), np.random.default_rng(0), program=PROGRAM)


@contextlib.asynccontextmanager
async def joined(manager, folder, **options):
    """Run a daemon that has joined the manager; stop it at the end."""
    async with serving(manager) as address:
        daemon = _daemon(address, folder, **options)
        task = asyncio.create_task(daemon.run())
        try:
            await _until(lambda: manager.states or task.done())
            yield daemon, task
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, SupersededError):
                await task


_until = functools.partial(waiting.until, limit_s=15.0)


def _done(manager):
    return [result.ref.lease_id for result in manager.results]


async def test_it_registers_with_its_resources_and_reports_its_state_first(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path):
        assert manager.registrations[0].worker_id == "w1"
        assert manager.resources.slots == 2
        assert manager.states[0].residents == ()


async def test_desired_scene_becomes_warm_and_lease_returns_a_score(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        manager.want(digest)
        await _until(lambda: any(r.state is ResidentState.WARM for s in manager.states for r in s.residents))
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    outcome = manager.results[0].outcome
    assert isinstance(outcome, Completed)
    assert outcome.worker_id == "w1"
    assert outcome.warm


async def test_heartbeats_renew_held_leases(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path):
        manager.lease("l1", manager.bundle(b"ok"), "slow")
        await _until(lambda: ["l1"] in manager.renewed)


async def test_many_leases_are_executed_once_each(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        for number in range(200):
            manager.lease(f"l{number}", digest)
        await _until(lambda: len(manager.results) >= 200)
        await asyncio.sleep(0.1)
    assert sorted(_done(manager)) == sorted(f"l{number}" for number in range(200))


async def test_results_share_messages_while_slots_have_enough_leases(tmp_path, monkeypatch):
    # Long enough to make the count independent of the machine's speed.
    monkeypatch.setattr(session, "LINGER_S", 60.0)
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        manager.want(digest)
        # Sent in one message: single leases might finish before enough of them wait.
        manager.leases(200, digest)
        await _until(lambda: len(manager.results) >= 200)
    assert manager.deliveries < 100


async def test_results_beyond_one_message_are_resent_in_several(tmp_path):
    """Six MB of results, where a message may have four: the fake checks each message as a manager does."""
    manager = FakeManager(acknowledging=False)
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path) as (_, task):
        manager.leases(100, digest, "long")
        await _until(lambda: len(manager.results) == 100)
        sent = len(manager.states)
        manager.break_stream()
        await _until(lambda: len(manager.results) == 200 or task.done())
        assert len(set(_done(manager))) == 100
        assert len(manager.states[sent].running) == 100


async def test_broken_stream_is_reopened_and_unacknowledged_results_are_resent(tmp_path):
    manager = FakeManager(acknowledging=False)
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
        manager.break_stream()
        await _until(lambda: len(manager.results) == 2)
        assert _done(manager) == ["l1", "l1"]
        assert len(manager.registrations) == 1
        manager.acknowledge(manager.results[0].ref)
        manager.lease("l2", digest)
        await _until(lambda: "l2" in _done(manager))
        manager.break_stream()
        await _until(lambda: len(manager.results) == 4)
    assert _done(manager) == ["l1", "l1", "l2", "l2"]


async def test_heartbeats_report_the_steps_of_running_rollouts(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path):
        digest = manager.bundle(b"ok")
        manager.lease("l1", digest, "steps")
        manager.lease("l2", digest, "hang", deadline_s=600.0)
        await _until(lambda: manager.steps.get("l1", [0])[-1] > 10)
        assert manager.steps["l1"] == sorted(manager.steps["l1"])
        await _until(lambda: manager.steps.get("l2", [])[-2:] == [2, 2])


async def test_worker_stays_after_its_drain_was_cancelled(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path):
        digest = manager.bundle(b"ok")
        manager.lease("l1", digest, "steps")
        await _until(lambda: ["l1"] in manager.renewed)
        manager.drain()
        await _until(lambda: manager.states[-1].draining)
        manager.resume()
        await _until(lambda: not manager.states[-1].draining)
        manager.lease("l2", digest)
        await _until(lambda: "l2" in _done(manager))


async def test_leases_continue_while_the_stream_is_broken(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path):
        manager.lease("l1", manager.bundle(b"ok"), "slow")
        await _until(lambda: ["l1"] in manager.renewed)
        manager.break_stream()
        await _until(lambda: _done(manager) == ["l1"])
        assert [ref.lease_id for ref in manager.states[-1].running] in (["l1"], [])


async def test_worker_registers_again_with_a_manager_that_forgot_its_session(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        manager.lease("old", digest, "hang", deadline_s=600.0)
        await _until(lambda: ["old"] in manager.renewed)
        manager.forget_session()
        await _until(lambda: len(manager.registrations) == 2)
        manager.lease("new", digest)
        await _until(lambda: manager.results)
    assert _done(manager) == ["new"]


async def test_worker_joins_a_returning_manager(tmp_path):
    manager = FakeManager()
    async with serving(manager) as address:
        pass
    daemon = _daemon(address, tmp_path)
    task = asyncio.create_task(daemon.run())
    await asyncio.sleep(0.6)
    assert not task.done()
    async with serving(manager, port=address.rpartition(":")[2]):
        await _until(lambda: manager.states)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def test_once_ends_the_daemon_if_the_manager_is_absent(tmp_path):
    daemon = _daemon("127.0.0.1:1", tmp_path, once=True)
    with pytest.raises(ManagerUnreachableError, match=re.escape("no manager answers at 127.0.0.1:1")):
        await daemon.run()


async def test_unrenewable_leases_are_stopped(tmp_path):
    manager = FakeManager(lease_ttl_s=0.5, answering_heartbeats=False)
    async with joined(manager, tmp_path) as (daemon, _):
        manager.lease("l1", manager.bundle(b"ok"), "hang", deadline_s=600.0)
        await _until(lambda: daemon.held == 1)
        await _until(lambda: daemon.held == 0)
    assert manager.results == []


async def test_repeated_session_conflicts_end_the_daemon(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path) as (_, task):
        for count in range(1, 5):
            await _until(lambda count=count: len(manager.registrations) >= count or task.done())
            manager.forget_session()
        with pytest.raises(SupersededError, match="another worker of that name"):
            await asyncio.wait_for(task, 10)


async def test_lost_sessions_do_not_look_like_another_worker_of_the_name(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path) as (_, task):
        for count in range(1, 8):
            await _until(lambda count=count: len(manager.registrations) >= count or task.done())
            manager.lose_session()
        await _until(lambda: len(manager.registrations) >= 8 or task.done())
        assert not task.done()
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    assert _done(manager) == ["l1"]


async def test_bundle_is_fetched_over_the_next_connection_if_one_breaks(tmp_path):
    manager = FakeManager(breaking=True)
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    assert isinstance(manager.results[0].outcome, Completed)
    assert manager.fetches == [digest, digest]


async def test_cancelled_lease_gives_no_result(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path):
        ref = manager.lease("stuck", digest, "hang", deadline_s=600.0)
        await _until(lambda: ["stuck"] in manager.renewed)
        manager.cancel(ref)
        await _until(lambda: manager.renewed[-1] == [])
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    assert _done(manager) == ["l1"]


async def test_bundle_damaged_in_transit_is_fetched_once_more(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    manager.damaged.add(digest)
    async with joined(manager, tmp_path):
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    assert isinstance(manager.results[0].outcome, Completed)
    assert manager.fetches == [digest, digest]


async def test_bundle_missing_at_the_manager_fails_its_leases_with_the_reason(tmp_path):
    manager = FakeManager()
    digest = manager.bundle(b"ok")
    del manager.bundles[digest]
    async with joined(manager, tmp_path):
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
    outcome = manager.results[0].outcome
    assert outcome.code is InfraCode.SCENE_LOAD_FAILED
    assert "there is no bundle" in outcome.message


async def test_drain_finishes_running_leases_and_leaves(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path) as (daemon, task):
        manager.lease("l1", manager.bundle(b"ok"), "slow")
        await _until(lambda: ["l1"] in manager.renewed)
        daemon.stop()
        await asyncio.wait_for(task, 10)
    assert _done(manager) == ["l1"]
    assert manager.states[-1].draining


async def test_drained_idle_worker_leaves_at_once_without_a_manager(tmp_path):
    daemon = _daemon("127.0.0.1:1", tmp_path)
    task = asyncio.create_task(daemon.run())
    await asyncio.sleep(1.0)
    daemon.stop()
    await asyncio.wait_for(task, 2)


async def test_drained_worker_delivers_its_last_results_to_a_returning_manager(tmp_path):
    manager = FakeManager(acknowledging=False)
    digest = manager.bundle(b"ok")
    async with joined(manager, tmp_path) as (daemon, task):
        manager.lease("l1", digest)
        await _until(lambda: manager.results)
        manager.break_stream()
        manager.acknowledging = True
        daemon.stop()
        await asyncio.wait_for(task, 10)
    assert _done(manager) == ["l1", "l1"]


async def test_manager_can_request_a_drain(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path) as (_, task):
        manager.drain()
        await asyncio.wait_for(task, 10)


async def test_second_signal_ends_the_daemon_at_once(tmp_path):
    manager = FakeManager()
    async with joined(manager, tmp_path) as (daemon, task):
        manager.lease("l1", manager.bundle(b"ok"), "hang", deadline_s=600.0)
        await _until(lambda: ["l1"] in manager.renewed)
        daemon.stop()
        await asyncio.sleep(0.05)
        assert not task.done()
        daemon.stop()
        await asyncio.wait_for(task, 10)
