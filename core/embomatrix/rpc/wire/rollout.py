"""Conversion of plans, rollouts, turns and batches to and from protobuf."""

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, Literal

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.rpc.wire.bounds import MOST_EQUAL, TURNS, check
from embomatrix.rpc.wire.codec import (
    ConvertError,
    converters,
    each,
    each_known,
    enum_numbers,
    finite,
    inside,
    maker,
    required,
    through,
)
from embomatrix.rpc.wire.values import Batch, Rollout
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
from embomatrix.skills.turns import EpisodePrefix

ArgField = Literal["object_index", "source_index", "relation", "yaw", "distance", "room_name"]

SKILL_KINDS: Final = enum_numbers(Skill, types_pb2.SkillKind, "SKILL_KIND")
MAX_ROLLOUT_BYTES: Final = MAX_PLAN_BYTES + 4096
"""Largest serialized rollout: the largest plan plus its names."""
EQUAL_CHARS: Final = 1_500
"""Characters of the ids of equal rollouts in one message: beyond it another message begins."""
KNOWN: Final = 65_536
"""Capacity of the cache from serialized calls and steps to values. Plans of one model repeat most calls."""
_SKILLS: Final = {kind: skill for skill, kind in SKILL_KINDS.items()}
_FIELDS: Final[Mapping[Skill, tuple[tuple[ArgField, bool], ...]]] = {
    skill: tuple((arg.value, arg in taken) for arg in Arg) for skill, taken in SIGNATURES.items()
}
"""Fields of a call, in order, and whether the skill takes each."""


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
    """Return the call. Raise ConvertError unless it has exactly the arguments of its skill."""
    return through(_call_of, message.SerializeToString())


@functools.lru_cache(KNOWN)
def _call_of(data: bytes) -> SkillCall:
    message = types_pb2.SkillCall.FromString(data)
    check(message)
    skill = _SKILLS.get(message.skill)
    if skill is None:
        raise ConvertError(
            "skill", f"found the unknown skill {message.skill}: if the sender is newer, upgrade this side"
        )
    taken = SIGNATURES[skill]
    for field, is_taken in _FIELDS[skill]:
        if message.HasField(field) != is_taken:
            problem = (
                "found no value: {} needs one" if is_taken else "found a value: {} takes none; leave it out"
            )
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
        raise ConvertError("room_name", f"found {len(text)} characters: expected at most {MAX_ROOM_NAME}")
    return text


def _relation(text: str) -> PlaceRelation:
    try:
        return PlaceRelation(text)
    except ValueError:
        raise ConvertError(
            "relation", f"found {text!r}: expected one of {', '.join(PlaceRelation)}"
        ) from None


def _plan_from(calls: Sequence[bytes]) -> Plan:
    if len(calls) > MAX_STEPS:
        raise ConvertError("plan", f"found {len(calls)} steps: expected at most {MAX_STEPS}")
    return each_known("plan", _call_of, calls)


_prefix_to_proto, _prefix_from_proto = converters(EpisodePrefix, types_pb2.EpisodePrefix)


def write_rollout(rollout: Rollout, message: types_pb2.Rollout) -> None:
    """Fill an empty message. A rollout that was received is written with its original bytes."""
    if rollout.wire:
        message.MergeFromString(rollout.wire)
        return
    message.rollout_id = rollout.rollout_id
    message.group_id = rollout.group_id
    message.bundle_digest = rollout.bundle_digest
    message.task_id = rollout.task_id
    message.plan.extend(map(skill_call_to_proto, rollout.plan))
    message.seed = rollout.seed
    message.render = rollout.render
    message.also.extend(rollout.also)
    message.sight = rollout.sight
    message.advise = rollout.advise
    if rollout.prefix is not None:
        message.prefix.SetInParent()
        message.prefix.MergeFrom(_prefix_to_proto(rollout.prefix))


rollout_to_proto = maker(types_pb2.Rollout, write_rollout)


def rollout_from_proto(message: types_pb2.Rollout) -> Rollout:
    """Return the rollout with its bytes. Raise ConvertError for more than ``MAX_ROLLOUT_BYTES`` before parsing the plan."""
    wire = message.SerializeToString()
    if len(wire) > MAX_ROLLOUT_BYTES:
        raise ConvertError(
            "plan", f"makes a rollout of {len(wire)} bytes: at most {MAX_ROLLOUT_BYTES} are accepted"
        )
    check(message)
    rollout = Rollout(
        rollout_id=required("rollout_id", message.rollout_id),
        group_id=required("group_id", message.group_id),
        bundle_digest=required("bundle_digest", message.bundle_digest),
        task_id=required("task_id", message.task_id),
        plan=_plan_from(types_pb2.RolloutCalls.FromString(wire).plan),
        seed=message.seed,
        render=message.render,
        also=tuple(message.also),
        prefix=_prefix_in(message),
        sight=message.sight,
        advise=message.advise,
    )
    _check_prefix(rollout)
    object.__setattr__(rollout, "wire", wire)
    return rollout


def unread_rollout(message: types_pb2.Rollout) -> Rollout:
    """Return the rollout without parsing its plan. The first access to the plan parses it."""
    return Rollout.unread(
        message.SerializeToString(),
        _read_rollout,
        bundle_digest=required("bundle_digest", message.bundle_digest),
        prefix=_prefix_in(message),
    )


def _prefix_in(message: types_pb2.Rollout) -> EpisodePrefix | None:
    return inside("prefix", _prefix_from_proto, message.prefix) if message.HasField("prefix") else None


def _check_prefix(rollout: Rollout) -> None:
    """Raise ConvertError for a prefix that is not a part of the plan."""
    prefix = rollout.prefix
    if prefix is None:
        for field in ("sight", "advise"):
            if getattr(rollout, field):
                raise ConvertError(field, "found it without a prefix: expected a turn of an episode")
        return
    if prefix.length + (not rollout.only_looks) > len(rollout.plan):
        expected = (
            "expected no more than the plan has"
            if rollout.only_looks
            else "expected fewer, since a turn without sight or advice has a new call"
        )
        raise ConvertError("prefix.length", f"found {prefix.length} of {len(rollout.plan)} calls: {expected}")
    if any(index >= after for index, after in itertools.pairwise((*prefix.failed, prefix.length))):
        raise ConvertError(
            "prefix.failed",
            f"found {', '.join(map(str, prefix.failed[:MAX_STEPS]))}: expected rising indices below {prefix.length}",
        )


def _read_rollout(wire: bytes) -> Rollout:
    return rollout_from_proto(types_pb2.Rollout.FromString(wire))


def merged(rollouts: Iterable[Rollout]) -> list[Rollout]:
    """Return the rollouts with equal ones as one, in order of the first of each.

    Only rollouts of one group are merged, at most as many as one message may name.
    """
    found: dict[tuple[object, ...], list[Rollout]] = {}
    for one in rollouts:
        key = (one.group_id, one.bundle_digest, one.task_id, one.seed, one.render, one.plan)
        found.setdefault(key, []).append(one)
    return [whole for equal in found.values() for whole in _wholes(equal)]


def _wholes(equal: Sequence[Rollout]) -> Iterator[Rollout]:
    """Yield equal rollouts as few."""
    if len(equal) == 1:
        yield equal[0]
        return
    names = [name for one in equal for name in (one.rollout_id, *one.also)]
    most = min(MOST_EQUAL, EQUAL_CHARS // max(map(len, names))) + 1
    for start in range(0, len(names), most):
        first, *also = names[start : start + most]
        yield dataclasses.replace(equal[0], rollout_id=first, also=tuple(also))


def batch_to_proto(batch: Batch) -> rollout_service_pb2.ExecuteRequest:
    message = rollout_service_pb2.ExecuteRequest(
        run_id=batch.run_id, batch_id=batch.batch_id, step=batch.step
    )
    for rollout in batch.rollouts:
        write_rollout(rollout, message.rollouts.add())
    return message


def batch_from_proto(message: rollout_service_pb2.ExecuteRequest) -> Batch:
    """Return the batch. Raise ConvertError for a repeated rollout id, since each rollout gets exactly one outcome."""
    return batch_with(message, each("rollouts", rollout_from_proto, message.rollouts))


def batch_with(message: rollout_service_pb2.ExecuteRequest, rollouts: tuple[Rollout, ...]) -> Batch:
    """Return the batch of a message whose rollouts are converted already."""
    _check_unique("rollouts", rollouts)
    batch = Batch(
        required("run_id", message.run_id), required("batch_id", message.batch_id), message.step, rollouts
    )
    object.__setattr__(batch, "wire", message.SerializeToString(deterministic=True))
    return batch


def _check_unique(field: str, rollouts: Sequence[Rollout]) -> None:
    seen: set[str] = set()
    for index, rollout in enumerate(rollouts):
        for rollout_id in (rollout.rollout_id, *rollout.also):
            if rollout_id in seen:
                raise ConvertError(
                    f"{field}[{index}].rollout_id", f"found {rollout_id!r} a second time: expected unique ids"
                )
            seen.add(required(f"{field}[{index}].also", rollout_id))


def turns_to_proto(run_id: str, turns: Sequence[Rollout]) -> rollout_service_pb2.StepRequest:
    message = rollout_service_pb2.StepRequest(run_id=run_id)
    for turn in turns:
        write_rollout(turn, message.turns.add())
    return message


def turn_from_proto(message: types_pb2.Rollout) -> Rollout:
    """Return the rollout of a turn. Raise ConvertError for one without a prefix."""
    if not message.HasField("prefix"):
        raise ConvertError("prefix", "found no value: a turn has one; submit other rollouts with Execute")
    return rollout_from_proto(message)


def checked_turns(turns: tuple[Rollout, ...]) -> tuple[Rollout, ...]:
    """Return the turns of one request. Raise ConvertError for none, and for a repeated id: each turn gets one result."""
    if not turns:
        raise ConvertError("turns", f"found none: expected 1 to {TURNS}")
    _check_unique("turns", turns)
    return turns
