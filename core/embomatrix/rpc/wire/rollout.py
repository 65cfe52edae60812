"""Plans and rollouts to wire messages and back. A malformed message is a ``ConvertError`` that names the field."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Final, Literal, TypeVar

from embomatrix.proto.v1 import types_pb2
from embomatrix.rpc.wire.values import Rollout
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

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

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


def each_known(field: str, known: Callable[[bytes], ValueT], messages: Sequence[bytes]) -> tuple[ValueT, ...]:
    """``each`` for messages that are looked up by their bytes: no line of Python for any of them, unless one is wrong."""
    try:
        return tuple(map(known, messages))
    except ConvertError:
        return each(field, known, messages)


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
    return _plan_from([message.SerializeToString() for message in messages])


def _plan_from(calls: Sequence[bytes]) -> Plan:
    if len(calls) > MAX_STEPS:
        raise ConvertError("plan", f"has {len(calls)} steps: at most {MAX_STEPS} are executed")
    return each_known("plan", _call_of, calls)


def rollout_to_proto(rollout: Rollout) -> types_pb2.Rollout:
    message = types_pb2.Rollout()
    write_rollout(rollout, message)
    return message


def write_rollout(rollout: Rollout, message: types_pb2.Rollout) -> None:
    """Fill an empty message. What came as a message is passed on as it came."""
    if rollout.wire:
        message.MergeFromString(rollout.wire)
        return
    message.rollout_id = rollout.rollout_id
    message.group_id = rollout.group_id
    message.bundle_digest = rollout.bundle_digest
    message.task_id = rollout.task_id
    message.plan.extend(plan_to_proto(rollout.plan))
    message.seed = rollout.seed
    message.render = rollout.render


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
        plan=_plan_from(types_pb2.RolloutCalls.FromString(wire).plan),
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
