"""Bounds of every field of the messages that a manager receives.

``BOUNDS`` is the only table of bounds; ``docs/protocol.md`` lists it. A message is checked by its size before it is parsed
and by its fields before it is converted, so no sender can make the manager hold, log or show a value that no sound sender
sends.
"""

from __future__ import annotations

import functools
import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message

from embomatrix.rpc.wire.codec import ConvertError, MessageT
from embomatrix.skills.syntax import MAX_ROOM_NAME, MAX_STEPS
from embomatrix.world.evaluate import MAX_ATOMS
from embomatrix.world.task import MAX_TABLE

LARGEST_EPOCH: Final = 2.0**63
NAME: Final = 256
"""Characters of an id or a digest."""
SENTENCE: Final = 2_000
"""Characters of a text for people."""
LOG_LINE: Final = 300
"""Characters of a line of a worker's log."""
LOG_LINES: Final = 20
"""Lines of a worker's log in one heartbeat."""
HELD_LEASES: Final = 4_096
"""Leases that a worker may hold, and unacknowledged results that it may keep."""
RESULT_BYTES: Final = 64 * 1024
"""Bytes of one result of a lease."""
RESULT_TEXT: Final = 4_000
"""Characters of a text in a result. The texts of a result with fewer bytes need no check."""
MOST_EQUAL: Final = 63
"""Further ids of equal rollouts in one message."""
TURNS: Final = 256
"""Turns of one call of ``Step``. All their results fit into one message."""
DAY_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class Bound:
    """Bound of one field: of a number, of the characters or bytes of a text, or of a repeated field's elements."""

    low: float = 0.0
    high: float = math.inf
    length: int = 0
    """Characters of a text, bytes of data; 0 for other fields."""
    count: int = 0
    """Elements of a repeated field; 0 for other fields."""

    def __str__(self) -> str:
        parts = [f"at most {self.count:,} elements"] if self.count else []
        parts += [f"at most {self.length:,} characters"] if self.length else []
        if self.high != math.inf:
            parts.append(f"{_number(self.low)} to {_number(self.high)}")
        return ", each ".join(parts)


def check_result(message: Message) -> None:
    """Check the result of a lease as `check` does. Texts and numbers of elements are examined in large results only.

    Numbers are checked by their conversion, and against the plan.
    """
    size = message.ByteSize()
    if size > RESULT_BYTES:
        raise ConvertError("outcome", f"found {size:,} bytes: expected at most {RESULT_BYTES:,}")
    if size > RESULT_TEXT:
        check(message)


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) < 1e9 and value == int(value) else f"{value:.6g}"


def _numbers(high: float, low: float = 0.0, count: int = 0) -> Bound:
    return Bound(low, high, count=count)


_ID: Final = Bound(length=NAME)
_TEXT: Final = Bound(length=SENTENCE)
_EPOCH: Final = _numbers(LARGEST_EPOCH)
_SECONDS: Final = _numbers(DAY_S)
_COUNT: Final = _numbers(1e6)
_INDEX: Final = _numbers(2.0**63, -(2.0**63))
_REWARD: Final = _numbers(1e9, -1e9)
_COEFFICIENT: Final = _numbers(1e6, -1e6)
_FINITE: Final = _numbers(sys.float_info.max, -sys.float_info.max)
_RESULT_TEXT: Final = Bound(length=RESULT_TEXT)

BOUNDS: Final[Mapping[str, Bound]] = {
    "RegisterRequest.worker_id": Bound(length=128),
    "RegisterRequest.boot_id": _ID,
    "RegisterRequest.protocol_version": _COUNT,
    "RegisterRequest.join_token": Bound(length=1_000),
    "RegisterRequest.protocol_low": _COUNT,
    "Resources.slots": _numbers(1_024),
    "Resources.cores": _numbers(65_536),
    "Resources.memory_mb": _numbers(1e9),
    "Resources.score": _numbers(1e6),
    "Resources.gpu": _ID,
    "Resources.vram_mb": _numbers(1e9),
    "Resources.versions": Bound(length=NAME, count=32),
    "Resources.disk_mb": _numbers(1e12),
    "Resources.render_slots": _numbers(1_024),
    "Resources.labels": Bound(length=NAME, count=32),
    "SessionRequest.session_id": _ID,
    "SessionRequest.session_epoch": _EPOCH,
    "SessionRequest.results": Bound(count=HELD_LEASES),
    "WorkerState.residents": Bound(count=HELD_LEASES),
    "WorkerState.running": Bound(count=2 * HELD_LEASES),
    "WorkerState.finished": Bound(count=HELD_LEASES),
    "WorkerState.paused": _TEXT,
    "WorkerState.claims": Bound(count=2 * HELD_LEASES),
    "Resident.bundle_digest": _ID,
    "Resident.state": _COUNT,
    "Resident.load_s": _SECONDS,
    "Resident.memory_mb": _numbers(1e9),
    "Resident.error": _TEXT,
    "LeaseRef.lease_id": _ID,
    "LeaseRef.lease_epoch": _EPOCH,
    "LeaseOrigin.run_id": _ID,
    "LeaseOrigin.batch_id": _ID,
    "LeaseOrigin.rollout_id": _ID,
    "LeaseOrigin.attempt": _numbers(1_000),
    "LeaseResult.slot": _numbers(1_024),
    "LeaseResult.held_s": _SECONDS,
    "Completed.steps": Bound(count=MAX_STEPS),
    "Completed.final_state": Bound(length=RESULT_TEXT, count=HELD_LEASES),
    "Completed.trace_digest": _RESULT_TEXT,
    "Completed.worker_id": _RESULT_TEXT,
    "Completed.shared_steps": _COUNT,
    "TurnObservation.room": _RESULT_TEXT,
    "TurnObservation.held": Bound(length=RESULT_TEXT, count=HELD_LEASES),
    "TurnObservation.changes": Bound(length=RESULT_TEXT, count=MAX_TABLE + 1),
    "TurnObservation.sees": Bound(count=MAX_TABLE),
    "Advice.plan": Bound(count=MAX_STEPS),
    "Advice.problem": _RESULT_TEXT,
    "Reward.format": _REWARD,
    "Reward.relevance": _REWARD,
    "Reward.goal": _REWARD,
    "Reward.atoms": Bound(count=MAX_ATOMS),
    "AtomResult.text": _RESULT_TEXT,
    "StepResult.failure": _RESULT_TEXT,
    "StepResult.message": _RESULT_TEXT,
    "StepResult.blocker": _RESULT_TEXT,
    "SkillCall.skill": _COUNT,
    "SkillCall.object_index": _INDEX,
    "SkillCall.source_index": _INDEX,
    "SkillCall.relation": _RESULT_TEXT,
    "SkillCall.yaw": _FINITE,
    "SkillCall.distance": _FINITE,
    "SkillCall.room_name": Bound(length=MAX_ROOM_NAME),
    "Timings.queued_s": _SECONDS,
    "Timings.load_s": _SECONDS,
    "Timings.execute_s": _SECONDS,
    "Timings.lease_s": _SECONDS,
    "Timings.deliver_s": _SECONDS,
    "InfraFailure.code": _COUNT,
    "InfraFailure.message": _RESULT_TEXT,
    "InfraFailure.worker_id": _RESULT_TEXT,
    "HeartbeatRequest.session_id": _ID,
    "HeartbeatRequest.session_epoch": _EPOCH,
    "HeartbeatRequest.running": Bound(count=2 * HELD_LEASES),
    "HeartbeatRequest.load": _numbers(1e6),
    "HeartbeatRequest.memory_used_mb": _numbers(1e9),
    "HeartbeatRequest.progress": Bound(count=2 * HELD_LEASES),
    "HeartbeatRequest.log_lines": Bound(length=LOG_LINE, count=LOG_LINES),
    "HostUse.cpu_share": _numbers(1.0),
    "HostUse.memory_used_mb": _numbers(1e9),
    "HostUse.memory_mb": _numbers(1e9),
    "LeaseProgress.steps": _COUNT,
    "FetchBundleRequest.session_id": _ID,
    "FetchBundleRequest.bundle_digest": _ID,
    "DeregisterRequest.session_id": _ID,
    "DeregisterRequest.session_epoch": _EPOCH,
    "OpenRunRequest.name": _ID,
    "OpenRunRequest.run_id": _ID,
    "OpenRunRequest.group_policy": _COUNT,
    "OpenRunRequest.weight": _numbers(1e6),
    "OpenRunRequest.priority": _numbers(1e6, -1e6),
    "OpenRunRequest.rollout_deadline_s": _SECONDS,
    "OpenRunRequest.protocol_version": _COUNT,
    "RewardSettings.unparsable": _COEFFICIENT,
    "RewardSettings.format": _COEFFICIENT,
    "RewardSettings.relevance_per_object": _COEFFICIENT,
    "RewardSettings.relevance_limit": _COEFFICIENT,
    "RewardSettings.goal": _COEFFICIENT,
    "AnnounceLookaheadRequest.run_id": _ID,
    "AnnounceLookaheadRequest.version": _EPOCH,
    "AnnounceLookaheadRequest.entries": Bound(count=4_096),
    "LookaheadEntry.step": _EPOCH,
    "LookaheadEntry.bundle_digest": _ID,
    "LookaheadEntry.count": _numbers(1e9),
    "ExecuteRequest.run_id": _ID,
    "ExecuteRequest.batch_id": _ID,
    "ExecuteRequest.step": _EPOCH,
    "ExecuteRequest.rollouts": Bound(count=65_536),
    "ExecuteRequest.policy_version": _EPOCH,
    "Rollout.rollout_id": _ID,
    "Rollout.group_id": _ID,
    "Rollout.bundle_digest": _ID,
    "Rollout.task_id": _ID,
    "Rollout.plan": Bound(count=MAX_STEPS),
    "Rollout.seed": _numbers(2.0**64),
    "Rollout.also": Bound(length=NAME, count=MOST_EQUAL),
    "EpisodePrefix.length": _numbers(MAX_STEPS),
    "EpisodePrefix.failed": Bound(count=MAX_STEPS),
    "EpisodePrefix.digest": _RESULT_TEXT,
    "StepRequest.run_id": _ID,
    "StepRequest.turns": Bound(count=TURNS),
    "WaitExecutionRequest.run_id": _ID,
    "WaitExecutionRequest.batch_id": _ID,
    "WaitExecutionRequest.after_cursor": _EPOCH,
    "CancelBatchRequest.run_id": _ID,
    "CancelBatchRequest.batch_id": _ID,
    "ReportTrainingRequest.run_id": _ID,
    "ReportTrainingRequest.phase": _ID,
    "ReportTrainingRequest.step": _EPOCH,
    "ReportTrainingRequest.figures": Bound(-math.inf, math.inf, length=NAME, count=256),
    "ReportTrainingRequest.plans": Bound(count=64),
    "SampledPlan.task_id": _ID,
    "SampledPlan.instruction": Bound(length=100_000),
    "SampledPlan.text": Bound(length=100_000),
    "SampledPlan.advantage": _FINITE,
    "SampledPlan.problem": _TEXT,
    "SampledPlan.steps": Bound(count=MAX_STEPS),
    "SampledPlan.turns": Bound(count=TURNS),
    "SampledPlan.opening": Bound(length=100_000),
    "SampledPlan.end": _ID,
    "RewardTiers.format": _REWARD,
    "RewardTiers.relevance": _REWARD,
    "RewardTiers.goal": _REWARD,
    "SampledStep.skill": _ID,
    "SampledStep.message": _TEXT,
    "SampledStep.call": _TEXT,
    "SampledTurn.answer": Bound(length=100_000),
    "SampledTurn.observation": Bound(length=100_000),
    "SampledTurn.steps": _COUNT,
    "CloseRunRequest.run_id": _ID,
    "DrainWorkerRequest.worker_id": _ID,
    "ResumeWorkerRequest.worker_id": _ID,
    "RevokeWorkerRequest.worker_id": _ID,
    "RevokeWorkerRequest.reason": _TEXT,
    "GetPlanRequest.run_id": _ID,
    "IssueTokenRequest.role": _COUNT,
    "IssueTokenRequest.valid_s": _numbers(1e10),
    "IssueTokenRequest.label": _ID,
    "RevokeTokenRequest.token_id": _ID,
    "GetRunRequest.run_id": _ID,
    "ReadEventsRequest.run_id": _ID,
    "ReadEventsRequest.after": _EPOCH,
    "ReadEventsRequest.limit": _numbers(2.0**32),
    "ExplainRolloutRequest.rollout_id": _ID,
    "MissingBundlesRequest.bundle_digests": Bound(length=NAME, count=65_536),
    "PutBundleRequest.bundle_digest": _ID,
    "PutBundleRequest.chunk": Bound(length=4 * 1024 * 1024),
    "GetBundleRequest.bundle_digest": _ID,
}
"""Bounds by message and field. Truth values and fields that hold one message have none."""

MESSAGE_BYTES: Final[Mapping[str, int]] = {
    "SessionRequest": 4 * 1024 * 1024,
    "ExecuteRequest": 32 * 1024 * 1024,
    "StepRequest": 8 * 1024 * 1024,
    "PutBundleRequest": 5 * 1024 * 1024,
    "AnnounceLookaheadRequest": 4 * 1024 * 1024,
    "MissingBundlesRequest": 8 * 1024 * 1024,
    "ReportTrainingRequest": 4 * 1024 * 1024,
}
"""Bytes of a whole message."""
OWN: Final = "embomatrix."
"""Package of the messages that have bounds; health checks and reflection have sizes only."""
OTHER_BYTES: Final = 2 * 1024 * 1024
"""Bytes of every other message."""
CONVERTED_LATER: Final = frozenset(
    {
        "SessionRequest.results",
        "WorkerState.finished",
        "ExecuteRequest.rollouts",
        "StepRequest.turns",
        "Completed.steps",
        "Rollout.plan",
    }
)
"""Repeated messages that are checked in slices, or once for equal bytes, while they are converted."""
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""Control characters and direction marks, which names may not have."""
_BOOLEAN: Final = FieldDescriptor.CPPTYPE_BOOL


def parsed(message_type: type[MessageT], data: bytes) -> MessageT:
    """Return the message in these bytes. Raise ConvertError if it is malformed, too large or out of bounds."""
    name = message_type.DESCRIPTOR.name
    most = MESSAGE_BYTES.get(name, OTHER_BYTES)
    if len(data) > most:
        raise ConvertError(
            name, f"found {len(data):,} bytes: expected at most {most:,}; send several messages"
        )
    try:
        message = message_type.FromString(data)
    except DecodeError:
        raise ConvertError(
            name, "found bytes that are no message of this kind: check the protocol version"
        ) from None
    if message_type.DESCRIPTOR.file.package.startswith(OWN):
        check(message)
    return message


def check(message: Message) -> None:
    """Raise ConvertError, with the path of the field, if a field of the message is out of bounds.

    Fields in ``CONVERTED_LATER`` are counted only.
    """
    rules = _rules_of(message.DESCRIPTOR)
    for field, value in message.ListFields():
        rule = rules[field.number]
        if rule is not None:
            rule(value)


@functools.cache
def _rules_of(descriptor: Descriptor) -> Mapping[int, Any]:
    return {field.number: _rule_of(field) for field in descriptor.fields}


def _rule_of(field: FieldDescriptor) -> Any:
    """Return the function that checks a value of the field; None if every value is allowed."""
    assert field.containing_type is not None
    name = f"{field.containing_type.name}.{field.name}"
    bound = BOUNDS.get(name)
    if is_map(field):
        assert bound is not None, name
        return lambda entries: _check_map(field.name, entries, bound)
    if is_repeated(field):
        assert bound is not None, name
        nested = field.message_type is not None and name not in CONVERTED_LATER
        one = check if nested else (_text_rule(field.name, bound) if bound.length else None)
        return lambda values: _check_each(field.name, values, bound.count, one)
    if field.message_type is not None:
        return lambda value: _check_inside(field.name, value)
    if field.cpp_type == _BOOLEAN:
        return None
    assert bound is not None, name
    return _text_rule(field.name, bound) if bound.length else _number_rule(field.name, bound)


def is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and bool(field.message_type.GetOptions().map_entry)


def is_repeated(field: FieldDescriptor) -> bool:
    return bool(field.default_value == [])  # protobuf 7 has no `label`, protobuf 5 no `is_repeated`


def _check_inside(field: str, value: Message) -> None:
    try:
        check(value)
    except ConvertError as error:
        raise error.under(field) from None


def _check_each(field: str, values: Any, count: int, one: Any) -> None:
    if len(values) > count:
        raise ConvertError(field, f"found {len(values):,} elements: expected at most {count:,}")
    if one is None:
        return
    for index, value in enumerate(values):
        try:
            one(value)
        except ConvertError as error:
            raise error.under(f"{field}[{index}]") from None


def _check_map(field: str, entries: Mapping[str, Any], bound: Bound) -> None:
    if len(entries) > bound.count:
        raise ConvertError(field, f"found {len(entries):,} elements: expected at most {bound.count:,}")
    texts: Iterable[Any] = (*entries, *(value for value in entries.values() if isinstance(value, str)))
    longest = max(map(len, texts), default=0)
    if longest > bound.length:
        raise ConvertError(
            field, f"found a text of {longest:,} characters: expected at most {bound.length:,}"
        )


def _text_rule(field: str, bound: Bound) -> Any:
    def rule(value: str | bytes) -> None:
        if len(value) > bound.length:
            raise ConvertError(field, f"found {len(value):,} characters: expected at most {bound.length:,}")
        if bound.length == NAME and isinstance(value, str) and _CONTROL.search(value):
            raise ConvertError(field, f"found {value[:80]!r}: expected a name without control characters")

    return rule


def _number_rule(field: str, bound: Bound) -> Any:
    def rule(value: float) -> None:
        if not bound.low <= value <= bound.high:
            raise ConvertError(field, f"found {value}: expected {bound}")

    return rule


def _most_bytes(message: str) -> str:
    """Return the limit of a request in bytes. Messages inside a request have no limit of their own."""
    return f"{MESSAGE_BYTES.get(message, OTHER_BYTES):,}" if message.endswith("Request") else "–"


def bounds_table() -> str:
    """Return the Markdown table of all bounds for ``docs/protocol.md``."""
    messages: dict[str, list[str]] = {}
    for name, bound in BOUNDS.items():
        message, _, field = name.partition(".")
        messages.setdefault(message, []).append(f"`{field}` {bound}")
    rows = [f"| `{name}` | {_most_bytes(name)} | {'; '.join(fields)} |" for name, fields in messages.items()]
    return "\n".join(("| message | bytes | fields |", "| --- | ---: | --- |", *rows))
