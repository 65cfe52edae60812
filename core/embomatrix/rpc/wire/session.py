"""Values of the worker's session and of the operator's view, to wire messages and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import admin_service_pb2, types_pb2, worker_service_pb2
from embomatrix.rpc.leases import (
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
from embomatrix.rpc.wire.rollout import (
    ConvertError,
    each,
    finite,
    inside,
    required,
    unread_rollout,
    write_rollout,
)
from embomatrix.rpc.wire.run import (
    reward_settings_of,
    reward_settings_to_proto,
    run_stats_from_proto,
    run_stats_to_proto,
    warmth_from_proto,
    warmth_to_proto,
)
from embomatrix.rpc.wire.values import (
    Completed,
    InfraFailure,
    PlanCell,
    Resident,
    ResidentState,
    Resources,
    RunInfo,
    WorkerInfo,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

_STATES: Final[Mapping[ResidentState, worker_service_pb2.ResidentState.ValueType]] = {
    state: worker_service_pb2.ResidentState.Value(f"RESIDENT_STATE_{state.name}") for state in ResidentState
}
_STATE_VALUES: Final = {number: state for state, number in _STATES.items()}
MAX_LABELS: Final = 32
"""Labels of one worker: more are a mistake, and every listing would carry them."""


def resources_to_proto(resources: Resources) -> types_pb2.Resources:
    return types_pb2.Resources(
        slots=resources.slots,
        cores=resources.cores,
        memory_mb=resources.memory_mb,
        score=resources.score,
        gpu=resources.gpu,
        vram_mb=resources.vram_mb,
        versions=dict(resources.versions),
        render_slots=resources.render_slots,
        disk_mb=resources.disk_mb,
        labels=dict(resources.labels),
    )


def resources_from_proto(message: types_pb2.Resources) -> Resources:
    if message.slots == 0:
        raise ConvertError("slots", "is 0: a worker offers at least one slot")
    if len(message.labels) > MAX_LABELS:
        raise ConvertError("labels", f"are {len(message.labels)}: a worker has at most {MAX_LABELS}")
    return Resources(
        slots=message.slots,
        cores=message.cores,
        memory_mb=message.memory_mb,
        score=finite("score", message.score),
        gpu=message.gpu,
        vram_mb=message.vram_mb,
        versions=dict(message.versions),
        render_slots=message.render_slots,
        disk_mb=message.disk_mb,
        labels=dict(message.labels),
    )


def resident_to_proto(resident: Resident) -> worker_service_pb2.Resident:
    return worker_service_pb2.Resident(
        bundle_digest=resident.bundle_digest,
        state=_STATES[resident.state],
        load_s=resident.load_s,
        memory_mb=resident.memory_mb,
        error=resident.error,
    )


def resident_from_proto(message: worker_service_pb2.Resident) -> Resident:
    state = _STATE_VALUES.get(message.state)
    if state is None:
        raise ConvertError("state", f"{message.state} is no known state: is the sender newer than this side?")
    return Resident(
        bundle_digest=required("bundle_digest", message.bundle_digest),
        state=state,
        load_s=finite("load_s", message.load_s),
        memory_mb=finite("memory_mb", message.memory_mb),
        error=message.error,
    )


def lease_ref_to_proto(ref: LeaseRef) -> worker_service_pb2.LeaseRef:
    message = worker_service_pb2.LeaseRef()
    write_lease_ref(ref, message)
    return message


def write_lease_ref(ref: LeaseRef, message: worker_service_pb2.LeaseRef) -> None:
    """Fill an empty message, such as one that was just added to a longer one: that spares a copy."""
    message.lease_id, message.lease_epoch = ref.lease_id, ref.lease_epoch


def lease_ref_from_proto(message: worker_service_pb2.LeaseRef) -> LeaseRef:
    return LeaseRef(required("lease_id", message.lease_id), message.lease_epoch)


def lease_progress_to_proto(progress: LeaseProgress) -> worker_service_pb2.LeaseProgress:
    return worker_service_pb2.LeaseProgress(ref=lease_ref_to_proto(progress.ref), steps=progress.steps)


def lease_progress_from_proto(message: worker_service_pb2.LeaseProgress) -> LeaseProgress:
    return LeaseProgress(inside("ref", lease_ref_from_proto, message.ref), message.steps)


def lease_origin_to_proto(origin: LeaseOrigin) -> worker_service_pb2.LeaseOrigin:
    message = worker_service_pb2.LeaseOrigin()
    write_lease_origin(origin, message)
    return message


def write_lease_origin(origin: LeaseOrigin, message: worker_service_pb2.LeaseOrigin) -> None:
    """Fill an empty message, as ``write_lease_ref`` does."""
    message.run_id, message.batch_id = origin.run_id, origin.batch_id
    message.rollout_id, message.attempt = origin.rollout_id, origin.attempt


def lease_origin_from_proto(message: worker_service_pb2.LeaseOrigin) -> LeaseOrigin:
    return LeaseOrigin(
        run_id=required("run_id", message.run_id),
        batch_id=required("batch_id", message.batch_id),
        rollout_id=required("rollout_id", message.rollout_id),
        attempt=max(message.attempt, 1),
    )


def lease_claim_to_proto(claim: LeaseClaim) -> worker_service_pb2.LeaseClaim:
    return worker_service_pb2.LeaseClaim(
        ref=lease_ref_to_proto(claim.ref), origin=lease_origin_to_proto(claim.origin)
    )


def lease_claim_from_proto(message: worker_service_pb2.LeaseClaim) -> LeaseClaim:
    return LeaseClaim(
        inside("ref", lease_ref_from_proto, message.ref),
        inside("origin", lease_origin_from_proto, message.origin),
    )


def lease_to_proto(lease: Lease) -> worker_service_pb2.Lease:
    message = worker_service_pb2.Lease()
    write_lease(lease, message)
    return message


def write_lease(lease: Lease, message: worker_service_pb2.Lease) -> None:
    """Fill an empty message, as ``write_lease_ref`` does."""
    write_lease_ref(lease.ref, message.ref)
    write_rollout(lease.rollout, message.rollout)
    message.deadline_s = lease.deadline_s
    if lease.origin is not None:
        write_lease_origin(lease.origin, message.origin)
    own = reward_settings_to_proto(lease.reward)
    if own is not None:
        message.reward.CopyFrom(own)


def lease_from_proto(message: worker_service_pb2.Lease) -> Lease:
    """The lease, with its rollout unread: the slot that executes it reads it."""
    ref = inside("ref", lease_ref_from_proto, message.ref)
    if finite("deadline_s", message.deadline_s) <= 0:
        raise ConvertError("deadline_s", f"is {message.deadline_s}: it must be above 0")
    origin = None
    if message.HasField("origin"):
        origin = inside("origin", lease_origin_from_proto, message.origin)
    return Lease(
        ref,
        inside("rollout", unread_rollout, message.rollout),
        message.deadline_s,
        origin,
        reward_settings_of(message),
    )


def lease_result_to_proto(result: LeaseResult) -> worker_service_pb2.LeaseResult:
    message = worker_service_pb2.LeaseResult()
    write_lease_result(result, message)
    return message


def write_lease_result(result: LeaseResult, message: worker_service_pb2.LeaseResult) -> None:
    """Fill an empty message, as ``write_lease_ref`` does."""
    write_lease_ref(result.ref, message.lease)
    message.slot, message.held_s = result.slot, result.held_s
    match result.outcome:
        case Completed() as completed:
            write_completed(completed, message.completed)
        case InfraFailure() as failure:
            message.infra_failure.CopyFrom(infra_failure_to_proto(failure))


def lease_result_from_proto(message: worker_service_pb2.LeaseResult) -> LeaseResult:
    ref = inside("lease", lease_ref_from_proto, message.lease)
    outcome: Completed | InfraFailure
    match message.WhichOneof("outcome"):
        case "completed":
            outcome = inside("completed", checked_completed, message.completed)
        case "infra_failure":
            outcome = inside("infra_failure", infra_failure_from_proto, message.infra_failure)
        case None:
            raise ConvertError("outcome", "is missing: a result has exactly one")
    return LeaseResult(ref, outcome, slot=message.slot, held_s=finite("held_s", message.held_s))


def worker_state_to_proto(state: WorkerState) -> worker_service_pb2.WorkerState:
    return worker_service_pb2.WorkerState(
        residents=[resident_to_proto(resident) for resident in state.residents],
        running=[lease_ref_to_proto(ref) for ref in state.running],
        finished=[lease_result_to_proto(result) for result in state.finished],
        draining=state.draining,
        paused=state.paused,
        claims=[lease_claim_to_proto(claim) for claim in state.claims],
    )


def worker_state_from_proto(message: worker_service_pb2.WorkerState) -> WorkerState:
    return WorkerState(
        residents=each("residents", resident_from_proto, message.residents),
        running=each("running", lease_ref_from_proto, message.running),
        finished=each("finished", lease_result_from_proto, message.finished),
        draining=message.draining,
        paused=message.paused,
        claims=each("claims", lease_claim_from_proto, message.claims),
    )


def worker_info_to_proto(info: WorkerInfo) -> admin_service_pb2.WorkerInfo:
    return admin_service_pb2.WorkerInfo(
        worker_id=info.worker_id,
        state=info.state,
        resources=resources_to_proto(info.resources),
        residents=[resident_to_proto(resident) for resident in info.residents],
        running=info.running,
        completed=info.completed,
        last_seen_s=info.last_seen_s,
        reason=info.reason,
        audited=info.audited,
        audit_mismatches=info.audit_mismatches,
    )


def worker_info_from_proto(message: admin_service_pb2.WorkerInfo) -> WorkerInfo:
    return WorkerInfo(
        worker_id=required("worker_id", message.worker_id),
        state=message.state,
        resources=inside("resources", resources_from_proto, message.resources),
        residents=each("residents", resident_from_proto, message.residents),
        running=message.running,
        completed=message.completed,
        last_seen_s=finite("last_seen_s", message.last_seen_s),
        reason=message.reason,
        audited=message.audited,
        audit_mismatches=message.audit_mismatches,
    )


def run_info_to_proto(info: RunInfo) -> admin_service_pb2.RunInfo:
    return admin_service_pb2.RunInfo(
        run_id=info.run_id,
        name=info.name,
        stats=run_stats_to_proto(info.stats),
        pending=info.pending,
        opened_s=info.opened_s,
        closed_s=info.closed_s,
        reward=reward_settings_to_proto(info.reward),
        waits_for=info.waits_for,
    )


def run_info_from_proto(message: admin_service_pb2.RunInfo) -> RunInfo:
    return RunInfo(
        required("run_id", message.run_id),
        message.name,
        run_stats_from_proto(message.stats),
        message.pending,
        finite("opened_s", message.opened_s),
        finite("closed_s", message.closed_s),
        reward_settings_of(message),
        message.waits_for,
    )


def plan_cell_to_proto(cell: PlanCell) -> admin_service_pb2.PlanCell:
    return admin_service_pb2.PlanCell(
        run_id=cell.run_id,
        step=cell.step,
        bundle_digest=cell.bundle_digest,
        count=cell.count,
        warmth=warmth_to_proto(cell.warmth),
        worker_ids=cell.worker_ids,
    )


def plan_cell_from_proto(message: admin_service_pb2.PlanCell) -> PlanCell:
    return PlanCell(
        run_id=required("run_id", message.run_id),
        step=message.step,
        bundle_digest=required("bundle_digest", message.bundle_digest),
        count=message.count,
        warmth=warmth_from_proto(message.warmth),
        worker_ids=tuple(message.worker_ids),
    )
