"""Conversion of rollout outcomes to and from protobuf."""

import functools

from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.wire.bounds import DAY_S, check
from embomatrix.rpc.wire.codec import (
    ConvertError,
    converters,
    each_known,
    enum_numbers,
    inside,
    maker,
    required,
    within,
)
from embomatrix.rpc.wire.rollout import KNOWN, skill_call_from_proto, skill_call_to_proto
from embomatrix.rpc.wire.values import (
    Cancelled,
    Completed,
    InfraCode,
    InfraFailure,
    Outcome,
    RolloutResult,
    Timings,
)
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import Advice, TurnObservation

reward_to_proto, reward_from_proto = converters(
    RewardBreakdown,
    types_pb2.Reward,
    parts={"atoms": converters(AtomResult, types_pb2.AtomResult)},
)
_observation_to_proto, _observation_from_proto = converters(
    TurnObservation,
    types_pb2.TurnObservation,
    absent={"advice": None},
    parts={
        "advice": converters(
            Advice, types_pb2.Advice, parts={"plan": (skill_call_to_proto, skill_call_from_proto)}
        )
    },
)
infra_failure_to_proto, infra_failure_from_proto = converters(
    InfraFailure,
    types_pb2.InfraFailure,
    enums={"code": enum_numbers(InfraCode, types_pb2.InfraCode, "INFRA_CODE")},
)


def step_to_proto(step: Step) -> types_pb2.StepResult:
    failure = "" if step.failure is None else step.failure.value
    return types_pb2.StepResult(
        call=skill_call_to_proto(step.call), failure=failure, message=step.message, blocker=step.blocker
    )


@functools.lru_cache(KNOWN)
def _step_of(data: bytes) -> Step:
    message = types_pb2.StepResult.FromString(data)
    check(message)
    call = inside("call", skill_call_from_proto, message.call)
    return Step(call, _failure_reason(message.failure), message.message, message.blocker)


def _failure_reason(text: str) -> FailureReason | None:
    if not text:
        return None
    try:
        return FailureReason(text)
    except ValueError:
        raise ConvertError(
            "failure", f"found the unknown reason {text!r}: if the sender is newer, upgrade this side"
        ) from None


def _write_timings(timings: Timings, message: types_pb2.Timings) -> None:
    """Overwrite all timings of the message."""
    message.queued_s, message.load_s, message.execute_s = timings.queued_s, timings.load_s, timings.execute_s
    message.lease_s, message.deliver_s = timings.lease_s, timings.deliver_s


timings_to_proto = maker(types_pb2.Timings, _write_timings)


def timings_from_proto(message: types_pb2.Timings) -> Timings:
    durations_s = (message.queued_s, message.load_s, message.execute_s, message.lease_s, message.deliver_s)
    if not (min(durations_s) >= 0.0 and sum(durations_s) <= DAY_S):
        for name, seconds in zip(Timings.__slots__, durations_s, strict=True):
            within(name, seconds, DAY_S)
    return Timings(*durations_s)


def write_completed(completed: Completed, message: types_pb2.Completed) -> None:
    """Fill an empty message. A received result is written with its original bytes plus the ``noted`` fields."""
    if completed.wire:
        message.MergeFromString(completed.wire)
    else:
        message.reward.CopyFrom(reward_to_proto(completed.reward))
        message.steps.extend(step_to_proto(step) for step in completed.steps)
        message.final_state.extend(completed.final)
        message.trace_digest = completed.trace_digest
        message.shared_steps = completed.shared_steps
        if completed.observation is not None:
            message.observation.SetInParent()
            message.observation.MergeFrom(_observation_to_proto(completed.observation))
    message.worker_id = completed.worker_id
    message.timings.SetInParent()
    _write_timings(completed.timings, message.timings)
    message.warm = completed.warm


completed_to_proto = maker(types_pb2.Completed, write_completed)


def completed_from_proto(message: types_pb2.Completed) -> Completed:
    """Return the result. Raise ConvertError for a missing reward, which is not a reward of 0."""
    wire = message.SerializeToString()
    completed = Completed(
        reward=inside("reward", reward_from_proto, _reward_in(message)),
        steps=_steps_in(wire),
        final=tuple(message.final_state),
        trace_digest=message.trace_digest,
        worker_id=message.worker_id,
        timings=inside("timings", timings_from_proto, message.timings),
        warm=message.warm,
        shared_steps=message.shared_steps,
        observation=_observation_in(message),
    )
    object.__setattr__(completed, "wire", wire)
    return completed


def checked_completed(message: types_pb2.Completed) -> Completed:
    """Return the result after the same checks. Texts of the final state and the digest are parsed on first access."""
    reward = inside("reward", reward_from_proto, _reward_in(message))
    wire = message.SerializeToString()
    return Completed.unread(
        wire,
        _read_completed,
        reward=reward,
        steps=_steps_in(wire),
        timings=inside("timings", timings_from_proto, message.timings),
        warm=message.warm,
        worker_id=message.worker_id,
        shared_steps=message.shared_steps,
        observation=_observation_in(message),
    )


def _observation_in(message: types_pb2.Completed) -> TurnObservation | None:
    return _observation_from_proto(message.observation) if message.HasField("observation") else None


def _steps_in(wire: bytes) -> tuple[Step, ...]:
    return each_known("steps", _step_of, types_pb2.CompletedSteps.FromString(wire).steps)


def _reward_in(message: types_pb2.Completed) -> types_pb2.Reward:
    if not message.HasField("reward"):
        raise ConvertError("reward", "found no value: a completed rollout has one")
    return message.reward


def unread_completed(wire: bytes, *, timings: Timings, warm: bool) -> Completed:
    """Return the result in these bytes unchecked. The first access to a value parses it."""
    return Completed.unread(wire, _read_completed, timings=timings, warm=warm, worker_id="")


def _read_completed(wire: bytes) -> Completed:
    return completed_from_proto(types_pb2.Completed.FromString(wire))


def rollout_result_to_proto(result: RolloutResult) -> types_pb2.RolloutResult:
    message = types_pb2.RolloutResult(
        rollout_id=result.rollout_id,
        group_id=result.group_id,
        cursor=result.cursor,
        attempt=result.attempt,
        also=result.also,
    )
    match result.outcome:
        case Completed() as completed:
            write_completed(completed, message.completed)
        case InfraFailure() as failure:
            message.infra_failure.CopyFrom(infra_failure_to_proto(failure))
        case Cancelled() as cancelled:
            message.cancelled.CopyFrom(types_pb2.Cancelled(reason=cancelled.reason))
    return message


def rollout_result_from_proto(message: types_pb2.RolloutResult) -> RolloutResult:
    return RolloutResult(
        rollout_id=required("rollout_id", message.rollout_id),
        group_id=message.group_id,
        cursor=message.cursor,
        attempt=message.attempt,
        outcome=_outcome(message),
        also=tuple(message.also),
    )


def _outcome(message: types_pb2.RolloutResult) -> Outcome:
    match message.WhichOneof("outcome"):
        case "completed":
            return inside("completed", completed_from_proto, message.completed)
        case "infra_failure":
            return inside("infra_failure", infra_failure_from_proto, message.infra_failure)
        case "cancelled":
            return Cancelled(message.cancelled.reason)
        case None:
            raise ConvertError("outcome", "found no value: expected completed, infra_failure or cancelled")
