"""Values of worker sessions and operator lists round-trip through protobuf."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.leases import lease_to_proto

from embomatrix.proto.v1 import worker_service_pb2
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.rpc.wire import session as convert
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.leases import (
    Lease,
    LeaseClaim,
    LeaseOrigin,
    LeaseProgress,
    LeaseRef,
    LeaseResult,
    WorkerState,
)
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    InfraFailure,
    PlanCell,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    RunInfo,
    RunStats,
    Timings,
    Warmth,
    WorkerInfo,
)
from embomatrix.skills.syntax import Skill, SkillCall

NAMES = st.text("abcdefgh-0123", min_size=1, max_size=12)
SECONDS = st.floats(0.001, 10_000)
REFS = st.builds(LeaseRef, NAMES, st.integers(0, 2**64 - 1))
ORIGINS = st.builds(LeaseOrigin, NAMES, NAMES, NAMES, st.integers(1, 9))
RESIDENTS = st.builds(Resident, NAMES, st.sampled_from(ResidentState), SECONDS, SECONDS, NAMES)
COMPLETED = st.builds(
    Completed,
    st.just(RewardBreakdown(0.5, 0.2, 30.0, (), True)),
    st.just(()),
    st.just(("apple is on the table",)),
    NAMES,
    NAMES,
    st.builds(Timings, SECONDS, SECONDS, SECONDS),
    st.booleans(),
)
RESULTS = st.builds(
    LeaseResult, REFS, COMPLETED | st.builds(InfraFailure, st.sampled_from(InfraCode), NAMES, NAMES)
)
STATES = st.builds(
    WorkerState,
    st.lists(RESIDENTS, max_size=3).map(tuple),
    st.lists(REFS, max_size=3).map(tuple),
    st.lists(RESULTS, max_size=3).map(tuple),
    st.booleans(),
    NAMES | st.just(""),
    st.lists(st.builds(LeaseClaim, REFS, ORIGINS), max_size=3).map(tuple),
)
PLAN = (SkillCall(Skill.TURN, yaw=0.5),)


def _over_the_wire(message):
    return type(message).FromString(message.SerializeToString())


@given(STATES)
def test_worker_state_round_trips(state):
    assert convert.worker_state_from_proto(_over_the_wire(convert.worker_state_to_proto(state))) == state


@given(st.builds(LeaseProgress, REFS, st.integers(0, 2**64 - 1)))
def test_lease_progress_round_trips(progress):
    message = _over_the_wire(convert.lease_progress_to_proto(progress))
    assert convert.lease_progress_from_proto(message) == progress


@given(
    st.builds(
        PlanCell,
        NAMES,
        st.integers(0, 2**64 - 1),
        NAMES,
        st.integers(0, 2**32 - 1),
        st.sampled_from(Warmth),
        st.lists(NAMES, max_size=3).map(tuple),
    )
)
def test_plan_cell_round_trips(cell):
    assert convert.plan_cell_from_proto(_over_the_wire(convert.plan_cell_to_proto(cell))) == cell


@given(
    st.builds(Lease, REFS, st.builds(Rollout, NAMES, NAMES, NAMES, NAMES, st.just(PLAN), st.just(7)), SECONDS)
)
def test_lease_round_trips(lease):
    assert convert.lease_from_proto(_over_the_wire(lease_to_proto(lease))) == lease


@given(st.lists(RESIDENTS, max_size=2).map(tuple), SECONDS)
def test_worker_info_round_trips(residents, last_seen_s):
    info = WorkerInfo("w1", "ready", Resources(2, 4, 1024), residents, 1, 17, last_seen_s)
    assert convert.worker_info_from_proto(_over_the_wire(convert.worker_info_to_proto(info))) == info


def test_run_info_round_trips():
    info = RunInfo("run-1", "demo", RunStats(delivered=5, stale_results=1), 3)
    assert convert.run_info_from_proto(_over_the_wire(convert.run_info_to_proto(info))) == info


def test_every_wire_resident_state_has_a_member():
    assert len(ResidentState) == len(worker_service_pb2.ResidentState.keys()) - 1


def test_lease_without_a_deadline_is_refused():
    message = worker_service_pb2.Lease(ref=worker_service_pb2.LeaseRef(lease_id="l1", lease_epoch=1))
    with pytest.raises(ConvertError, match=r"deadline_s: found 0\.0: expected a number above 0"):
        convert.lease_from_proto(message)


def test_malformed_result_error_names_the_element():
    message = worker_service_pb2.WorkerState(finished=[worker_service_pb2.LeaseResult()])
    with pytest.raises(ConvertError, match=r"finished\[0\].lease.lease_id: found no value"):
        convert.worker_state_from_proto(message)
