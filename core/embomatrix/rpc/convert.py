"""Values to wire messages and back. A malformed message is a ``ConvertError`` that names the field."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Final, Literal, TypeVar

from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.values import (
    Cancelled,
    Completed,
    InfraCode,
    InfraFailure,
    Rollout,
    RolloutResult,
    Timings,
)
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import (
    MAX_PLAN_BYTES,
    MAX_ROOM_NAME,
    MAX_STEPS,
    SIGNATURES,
    Arg,
    PlaceRelation,
    Plan,
    Skill,
    SkillCall,
)
from embomatrix.skills.trace import Step

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from embomatrix.rpc.values import Outcome

ArgField = Literal["object_index", "source_index", "relation", "yaw", "distance", "room_name"]
WireT = TypeVar("WireT")
ValueT = TypeVar("ValueT")

SKILL_KINDS: Final[Mapping[Skill, types_pb2.SkillKind.ValueType]] = {
    Skill.MOVE: types_pb2.SKILL_KIND_MOVE,
    Skill.TURN: types_pb2.SKILL_KIND_TURN,
    Skill.PICK_UP: types_pb2.SKILL_KIND_PICK_UP,
    Skill.PLACE: types_pb2.SKILL_KIND_PLACE,
    Skill.MOVE_FORWARD: types_pb2.SKILL_KIND_MOVE_FORWARD,
    Skill.OPEN: types_pb2.SKILL_KIND_OPEN,
    Skill.CLOSE: types_pb2.SKILL_KIND_CLOSE,
    Skill.TOGGLE_ON: types_pb2.SKILL_KIND_TOGGLE_ON,
    Skill.TOGGLE_OFF: types_pb2.SKILL_KIND_TOGGLE_OFF,
    Skill.HEAT: types_pb2.SKILL_KIND_HEAT,
    Skill.COOK: types_pb2.SKILL_KIND_COOK,
    Skill.FREEZE: types_pb2.SKILL_KIND_FREEZE,
    Skill.GO_TO_ROOM: types_pb2.SKILL_KIND_GO_TO_ROOM,
    Skill.SLICE: types_pb2.SKILL_KIND_SLICE,
    Skill.CLEAN: types_pb2.SKILL_KIND_CLEAN,
    Skill.SOAK: types_pb2.SKILL_KIND_SOAK,
}
MAX_ROLLOUT_BYTES: Final = MAX_PLAN_BYTES + 4096
"""On the wire: the largest plan, and its names."""
KNOWN: Final = 65_536
"""Calls and steps that a process remembers by their bytes: plans of one model repeat them, and so do the results."""
_SKILLS: Final = {kind: skill for skill, kind in SKILL_KINDS.items()}
_FIELDS: Final[Mapping[Skill, tuple[tuple[ArgField, bool], ...]]] = {
    skill: tuple((arg.value, arg in taken) for arg in Arg) for skill, taken in SIGNATURES.items()
}
"""For each skill the fields of a call, in order, and whether the skill takes them."""
_INFRA_CODES: Final[Mapping[InfraCode, types_pb2.InfraCode.ValueType]] = {
    code: types_pb2.InfraCode.Value(f"INFRA_CODE_{code.name}") for code in InfraCode
}
_INFRA_VALUES: Final = {number: code for code, number in _INFRA_CODES.items()}


class ConvertError(ValueError):
    """A message that can't be a value. ``field`` is the culprit's path: ``rollouts[3].plan[0].yaw``."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem

    def under(self, parent: str) -> ConvertError:
        """The same error, seen from the message that holds this one."""
        return ConvertError(f"{parent}.{self.field}", self.problem)


def each(
    field: str, convert: Callable[[WireT], ValueT], messages: Iterable[WireT], *, first: int = 0
) -> tuple[ValueT, ...]:
    """Convert a repeated field, or its part from the element ``first`` on; an error tells which element it stands in."""
    values: list[ValueT] = []
    for index, message in enumerate(messages, start=first):
        try:
            values.append(convert(message))
        except ConvertError as error:
            raise error.under(f"{field}[{index}]") from None
    return tuple(values)


def inside(field: str, convert: Callable[[WireT], ValueT], message: WireT) -> ValueT:
    """Convert a message field; an error tells in which field it stands."""
    try:
        return convert(message)
    except ConvertError as error:
        raise error.under(field) from None


def required(field: str, text: str) -> str:
    """The text, which may not be empty."""
    if not text:
        raise ConvertError(field, "is empty: it must be set")
    return text


def finite(field: str, number: float) -> float:
    """The number, which may be neither NaN nor infinite."""
    if not math.isfinite(number):
        raise ConvertError(field, f"is {number}: it must be a finite number")
    return number


def skill_call_to_proto(call: SkillCall) -> types_pb2.SkillCall:
    return types_pb2.SkillCall(
        skill=SKILL_KINDS[call.skill],
        object_index=call.object_index,
        source_index=call.source_index,
        relation=None if call.relation is None else call.relation.value,
        yaw=call.yaw,
        distance=call.distance,
        room_name=call.room_name,
    )


def skill_call_from_proto(message: types_pb2.SkillCall) -> SkillCall:
    """The call, with exactly the arguments that its skill takes; any other set is a ``ConvertError``."""
    return _call_of(message.SerializeToString())


@functools.lru_cache(KNOWN)
def _call_of(data: bytes) -> SkillCall:
    message = types_pb2.SkillCall.FromString(data)
    skill = _SKILLS.get(message.skill)
    if skill is None:
        raise ConvertError("skill", f"{message.skill} is no known skill: is the sender newer than this side?")
    taken = SIGNATURES[skill]
    for field, is_taken in _FIELDS[skill]:
        if message.HasField(field) != is_taken:
            problem = "is missing: {} needs it" if is_taken else "is set: {} does not take it"
            raise ConvertError(field, problem.format(skill.value))
    return SkillCall(
        skill,
        object_index=message.object_index if Arg.OBJECT in taken else None,
        source_index=message.source_index if Arg.SOURCE in taken else None,
        relation=_relation(message.relation) if Arg.RELATION in taken else None,
        yaw=finite("yaw", message.yaw) if Arg.YAW in taken else None,
        distance=finite("distance", message.distance) if Arg.DISTANCE in taken else None,
        room_name=_room_name(message.room_name) if Arg.ROOM in taken else None,
    )


def _room_name(text: str) -> str:
    if len(text) > MAX_ROOM_NAME:
        raise ConvertError("room_name", f"has {len(text)} characters: at most {MAX_ROOM_NAME} name a room")
    return text


def _relation(text: str) -> PlaceRelation:
    try:
        return PlaceRelation(text)
    except ValueError:
        raise ConvertError("relation", f"{text!r} is none of {', '.join(PlaceRelation)}") from None


def plan_to_proto(plan: Plan) -> list[types_pb2.SkillCall]:
    return [skill_call_to_proto(call) for call in plan]


def plan_from_proto(messages: Iterable[types_pb2.SkillCall]) -> Plan:
    calls = tuple(messages)
    if len(calls) > MAX_STEPS:
        raise ConvertError("plan", f"has {len(calls)} steps: at most {MAX_STEPS} are executed")
    return each("plan", skill_call_from_proto, calls)


def rollout_to_proto(rollout: Rollout) -> types_pb2.Rollout:
    if rollout.wire:
        return types_pb2.Rollout.FromString(rollout.wire)
    return types_pb2.Rollout(
        rollout_id=rollout.rollout_id,
        group_id=rollout.group_id,
        bundle_digest=rollout.bundle_digest,
        task_id=rollout.task_id,
        plan=plan_to_proto(rollout.plan),
        seed=rollout.seed,
        render=rollout.render,
    )


def rollout_from_proto(message: types_pb2.Rollout) -> Rollout:
    """The rollout, which keeps its bytes; more of them than the largest plan takes are refused before they are looked at."""
    wire = message.SerializeToString()
    if len(wire) > MAX_ROLLOUT_BYTES:
        raise ConvertError(
            "plan", f"makes a rollout of {len(wire)} bytes: at most {MAX_ROLLOUT_BYTES} are taken"
        )
    rollout = Rollout(
        rollout_id=required("rollout_id", message.rollout_id),
        group_id=required("group_id", message.group_id),
        bundle_digest=required("bundle_digest", message.bundle_digest),
        task_id=required("task_id", message.task_id),
        plan=plan_from_proto(message.plan),
        seed=message.seed,
        render=message.render,
    )
    object.__setattr__(rollout, "wire", wire)
    return rollout


def unread_rollout(message: types_pb2.Rollout) -> Rollout:
    """The rollout for whoever only passes it on: whether its plan is one is found when it is read."""
    return Rollout.unread(
        message.SerializeToString(),
        _rollout_fields,
        bundle_digest=required("bundle_digest", message.bundle_digest),
    )


def _rollout_fields(wire: bytes) -> Mapping[str, object]:
    rollout = rollout_from_proto(types_pb2.Rollout.FromString(wire))
    return {
        name: getattr(rollout, name)
        for name in ("rollout_id", "group_id", "task_id", "plan", "seed", "render")
    }


def reward_to_proto(reward: RewardBreakdown) -> types_pb2.Reward:
    return types_pb2.Reward(
        format=reward.format,
        relevance=reward.relevance,
        goal=reward.goal,
        atoms=[types_pb2.AtomResult(text=atom.text, holds=atom.holds) for atom in reward.atoms],
        success=reward.success,
    )


def reward_from_proto(message: types_pb2.Reward) -> RewardBreakdown:
    return RewardBreakdown(
        format=finite("format", message.format),
        relevance=finite("relevance", message.relevance),
        goal=finite("goal", message.goal),
        atoms=tuple(AtomResult(atom.text, atom.holds) for atom in message.atoms),
        success=message.success,
    )


def step_to_proto(step: Step) -> types_pb2.StepResult:
    failure = "" if step.failure is None else step.failure.value
    return types_pb2.StepResult(call=skill_call_to_proto(step.call), failure=failure, message=step.message)


def step_from_proto(message: types_pb2.StepResult) -> Step:
    return _step_of(message.SerializeToString())


@functools.lru_cache(KNOWN)
def _step_of(data: bytes) -> Step:
    message = types_pb2.StepResult.FromString(data)
    call = inside("call", skill_call_from_proto, message.call)
    return Step(call, _failure_reason(message.failure), message.message)


def _failure_reason(text: str) -> FailureReason | None:
    if not text:
        return None
    try:
        return FailureReason(text)
    except ValueError:
        raise ConvertError("failure", f"{text!r} is no known failure reason") from None


def timings_to_proto(timings: Timings) -> types_pb2.Timings:
    return types_pb2.Timings(**{name: getattr(timings, name) for name in Timings.__slots__})


def timings_from_proto(message: types_pb2.Timings) -> Timings:
    return Timings(**{name: finite(name, getattr(message, name)) for name in Timings.__slots__})


def completed_to_proto(completed: Completed) -> types_pb2.Completed:
    message = types_pb2.Completed()
    write_completed(completed, message)
    return message


def write_completed(completed: Completed, message: types_pb2.Completed) -> None:
    """Fill an empty message. What came as a message is passed on as it came, but for what was noted on its way."""
    if completed.wire:
        message.MergeFromString(completed.wire)
    else:
        message.reward.CopyFrom(reward_to_proto(completed.reward))
        message.steps.extend(step_to_proto(step) for step in completed.steps)
        message.final_state.extend(completed.final)
        message.trace_digest = completed.trace_digest
    message.worker_id = completed.worker_id
    message.timings.CopyFrom(timings_to_proto(completed.timings))
    message.warm = completed.warm


def completed_from_proto(message: types_pb2.Completed) -> Completed:
    """The result. A missing reward is a ``ConvertError``, for it is no reward of 0."""
    if not message.HasField("reward"):
        raise ConvertError("reward", "is missing: a completed rollout has one")
    completed = Completed(
        reward=inside("reward", reward_from_proto, message.reward),
        steps=each("steps", step_from_proto, message.steps),
        final=tuple(message.final_state),
        trace_digest=message.trace_digest,
        worker_id=message.worker_id,
        timings=inside("timings", timings_from_proto, message.timings),
        warm=message.warm,
    )
    object.__setattr__(completed, "wire", message.SerializeToString())
    return completed


def unread_completed(wire: bytes, *, timings: Timings, warm: bool) -> Completed:
    """The result in this message for whoever only passes it on: what else it says is found when it is read."""
    return Completed.unread(wire, _completed_fields, timings=timings, warm=warm)


def _completed_fields(wire: bytes) -> Mapping[str, object]:
    completed = completed_from_proto(types_pb2.Completed.FromString(wire))
    return {name: getattr(completed, name) for name in ("reward", "steps", "final", "trace_digest")}


def infra_failure_to_proto(failure: InfraFailure) -> types_pb2.InfraFailure:
    return types_pb2.InfraFailure(
        code=_INFRA_CODES[failure.code], message=failure.message, worker_id=failure.worker_id
    )


def infra_failure_from_proto(message: types_pb2.InfraFailure) -> InfraFailure:
    code = _INFRA_VALUES.get(message.code)
    if code is None:
        raise ConvertError("code", f"{message.code} is no known code: is the sender newer than this side?")
    return InfraFailure(code, message.message, message.worker_id)


def rollout_result_to_proto(result: RolloutResult) -> types_pb2.RolloutResult:
    message = types_pb2.RolloutResult(
        rollout_id=result.rollout_id, group_id=result.group_id, cursor=result.cursor, attempt=result.attempt
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
            raise ConvertError("outcome", "is missing: a result has exactly one")
