"""A manager survives messages that break its state machines: the sender is quarantined and disconnected."""

import pytest

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.events import LeasesRenewed, Tick, WorkerReported
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.intake import Heartbeat
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.store.opening import open_store
from embomatrix.rpc.status import InternalError, SupersededError
from embomatrix.rpc.wire.leases import WorkerState
from embomatrix.rpc.wire.values import Resident, ResidentState, Resources


class FragileState(ClusterState):
    """State machines with a defect: they fail on events of one kind from one worker."""

    fails_on: type = type(None)

    def handle(self, *events, now_s):
        commands = super().handle(*events, now_s=now_s)
        if any(isinstance(event, self.fails_on) and event.worker_id == "bad" for event in events):
            raise KeyError("lease")
        return commands


@pytest.fixture
async def runtime(tmp_path):
    cluster = FragileState(lease_key=b"key")
    bundles = BundleStore(tmp_path / "bundles", total_bytes=1)
    archive = RunArchive(tmp_path / "runs")
    runtime = ManagerRuntime(cluster, Registry(LivenessLimits()), open_store("memory:"), bundles, archive)
    await runtime.start()
    for worker_id in ("good", "bad"):
        runtime.registry.register(worker_id, "", Resources(1, 1, 100), now_s=0.0)
        for event in runtime.registry.drain(worker_id) and runtime.registry.resume(worker_id):
            cluster.handle(event, now_s=0.0)
    return runtime


def beat(runtime, worker_id):
    session = runtime.registry.sessions[worker_id]
    return runtime.process_heartbeat(session.session_id, session.epoch, Heartbeat(()))


async def test_sender_of_a_heartbeat_that_breaks_the_state_is_quarantined(runtime):
    runtime.cluster.fails_on = LeasesRenewed
    with runtime.errors, pytest.raises(InternalError, match="worker bad is quarantined"):
        beat(runtime, "bad")
    assert runtime.cluster.dispatcher.auditor.of("bad").quarantine
    assert runtime.errors.total >= 1
    assert beat(runtime, "good") > 0
    with pytest.raises(SupersededError, match="register again"):
        beat(runtime, "bad")


async def test_sender_of_a_report_that_breaks_the_state_is_disconnected(runtime):
    runtime.cluster.fails_on = WorkerReported
    session = runtime.registry.sessions["bad"]
    with runtime.attached(session) as link:
        state = WorkerState((Resident("kitchen", ResidentState.WARM),))
        with pytest.raises(InternalError, match="broke the manager"):
            runtime.process_report(link, state, (), resync=True)
        with pytest.raises(InternalError, match="quarantined"):
            await link.take()
    assert session.standing.is_gone


async def test_events_after_a_failed_one_are_handled(runtime):
    runtime.cluster.fails_on = LeasesRenewed
    with pytest.raises(InternalError):
        beat(runtime, "bad")
    runtime.cluster.handle(Tick(), now_s=1e9)
    runtime.cluster.check_invariants()
