"""Conversion of worker sessions, and of the operator's lists, to and from protobuf."""

from typing import Final

from embomatrix.proto.v1 import admin_service_pb2, types_pb2, worker_service_pb2
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.wire.bounds import DAY_S, check_result
from embomatrix.rpc.wire.codec import (
    ConvertError,
    converters,
    enum_numbers,
    finite,
    inside,
    maker,
    required,
    within,
)
from embomatrix.rpc.wire.leases import (
    Lease,
    LeaseClaim,
    LeaseOrigin,
    LeaseProgress,
    LeaseRef,
    LeaseResult,
    WorkerState,
)
from embomatrix.rpc.wire.outcome import (
    checked_completed,
    infra_failure_from_proto,
    infra_failure_to_proto,
    write_completed,
)
from embomatrix.rpc.wire.rollout import unread_rollout, write_rollout
from embomatrix.rpc.wire.run import (
    WARMTHS,
    reward_settings_from_proto,
    reward_settings_to_proto,
    run_stats_from_proto,
    run_stats_to_proto,
)
from embomatrix.rpc.wire.values import (
    Completed,
    HostUse,
    InfraFailure,
    PlanCell,
    Resident,
    ResidentState,
    Resources,
    RunInfo,
    WorkerInfo,
)

MAX_LABELS: Final = 32
"""Labels of one worker at most, since every listing carries them."""

resources_to_proto, _resources_from_proto = converters(Resources, types_pb2.Resources)
resident_to_proto, resident_from_proto = converters(
    Resident,
    worker_service_pb2.Resident,
    required_names=("bundle_digest",),
    enums={"state": enum_numbers(ResidentState, worker_service_pb2.ResidentState, "RESIDENT_STATE")},
)
plan_cell_to_proto, plan_cell_from_proto = converters(
    PlanCell,
    admin_service_pb2.PlanCell,
    required_names=("run_id", "bundle_digest"),
    enums={"warmth": WARMTHS},
)
run_info_to_proto, run_info_from_proto = converters(
    RunInfo,
    admin_service_pb2.RunInfo,
    required_names=("run_id",),
    parts={
        "stats": (run_stats_to_proto, run_stats_from_proto),
        "reward": (reward_settings_to_proto, reward_settings_from_proto),
    },
    absent={"reward": PAPER},
)


def resources_from_proto(message: types_pb2.Resources) -> Resources:
    if message.slots == 0:
        raise ConvertError("slots", "found 0: expected at least one slot")
    if len(message.labels) > MAX_LABELS:
        raise ConvertError("labels", f"found {len(message.labels)}: expected at most {MAX_LABELS}")
    return _resources_from_proto(message)


worker_info_to_proto, worker_info_from_proto = converters(
    WorkerInfo,
    admin_service_pb2.WorkerInfo,
    required_names=("worker_id",),
    parts={
        "resources": (resources_to_proto, resources_from_proto),
        "residents": (resident_to_proto, resident_from_proto),
    },
)


def write_lease_ref(ref: LeaseRef, message: worker_service_pb2.LeaseRef) -> None:
    """Fill an empty message in place, which saves a copy."""
    message.lease_id, message.lease_epoch = ref.lease_id, ref.lease_epoch


lease_ref_to_proto = maker(worker_service_pb2.LeaseRef, write_lease_ref)


def lease_ref_from_proto(message: worker_service_pb2.LeaseRef) -> LeaseRef:
    return LeaseRef(required("lease_id", message.lease_id), message.lease_epoch)


def write_lease_origin(origin: LeaseOrigin, message: worker_service_pb2.LeaseOrigin) -> None:
    """Fill an empty message in place."""
    message.run_id, message.batch_id = origin.run_id, origin.batch_id
    message.rollout_id, message.attempt = origin.rollout_id, origin.attempt


lease_origin_to_proto = maker(worker_service_pb2.LeaseOrigin, write_lease_origin)


def lease_origin_from_proto(message: worker_service_pb2.LeaseOrigin) -> LeaseOrigin:
    return LeaseOrigin(
        run_id=required("run_id", message.run_id),
        batch_id=required("batch_id", message.batch_id),
        rollout_id=required("rollout_id", message.rollout_id),
        attempt=max(message.attempt, 1),
    )


def write_lease(lease: Lease, message: worker_service_pb2.Lease) -> None:
    """Fill an empty message in place."""
    write_lease_ref(lease.ref, message.ref)
    write_rollout(lease.rollout, message.rollout)
    message.deadline_s = lease.deadline_s
    if lease.origin is not None:
        write_lease_origin(lease.origin, message.origin)
    reward = reward_settings_to_proto(lease.reward)
    if reward is not None:
        message.reward.CopyFrom(reward)


def lease_from_proto(message: worker_service_pb2.Lease) -> Lease:
    """Return the lease with its rollout unparsed: the slot that executes it parses it."""
    ref = inside("ref", lease_ref_from_proto, message.ref)
    if finite("deadline_s", message.deadline_s) <= 0:
        raise ConvertError("deadline_s", f"found {message.deadline_s}: expected a number above 0")
    origin = None
    if message.HasField("origin"):
        origin = inside("origin", lease_origin_from_proto, message.origin)
    return Lease(
        ref,
        inside("rollout", unread_rollout, message.rollout),
        message.deadline_s,
        origin,
        inside("reward", reward_settings_from_proto, message.reward) if message.HasField("reward") else PAPER,
    )


def write_lease_result(result: LeaseResult, message: worker_service_pb2.LeaseResult) -> None:
    """Fill an empty message in place."""
    write_lease_ref(result.ref, message.lease)
    message.slot, message.held_s = result.slot, result.held_s
    match result.outcome:
        case Completed() as completed:
            write_completed(completed, message.completed)
        case InfraFailure() as failure:
            message.infra_failure.CopyFrom(infra_failure_to_proto(failure))


lease_result_to_proto = maker(worker_service_pb2.LeaseResult, write_lease_result)


def lease_result_from_proto(message: worker_service_pb2.LeaseResult) -> LeaseResult:
    check_result(message)
    ref = inside("lease", lease_ref_from_proto, message.lease)
    outcome: Completed | InfraFailure
    match message.WhichOneof("outcome"):
        case "completed":
            outcome = inside("completed", checked_completed, message.completed)
        case "infra_failure":
            outcome = inside("infra_failure", infra_failure_from_proto, message.infra_failure)
        case None:
            raise ConvertError("outcome", "found no value: expected completed or infra_failure")
    return LeaseResult(ref, outcome, slot=message.slot, held_s=within("held_s", message.held_s, DAY_S))


_LEASE_REF = (lease_ref_to_proto, lease_ref_from_proto)
lease_progress_to_proto, lease_progress_from_proto = converters(
    LeaseProgress, worker_service_pb2.LeaseProgress, parts={"ref": _LEASE_REF}
)
host_use_to_proto, host_use_from_proto = converters(HostUse, worker_service_pb2.HostUse)
worker_state_to_proto, worker_state_from_proto = converters(
    WorkerState,
    worker_service_pb2.WorkerState,
    parts={
        "residents": (resident_to_proto, resident_from_proto),
        "running": _LEASE_REF,
        "finished": (lease_result_to_proto, lease_result_from_proto),
        "claims": converters(
            LeaseClaim,
            worker_service_pb2.LeaseClaim,
            parts={"ref": _LEASE_REF, "origin": (lease_origin_to_proto, lease_origin_from_proto)},
        ),
    },
)
