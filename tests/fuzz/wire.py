"""Decoders of every message of the protocol: requests at the manager, answers at workers, trainers and operators.

The first byte of an input selects the type of the message. A converted value is written and read once more, as by the next
machine.
"""

from __future__ import annotations

import dataclasses
import functools
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from tests.fuzz.decoder import Decoder, mutate_bytes

from embomatrix.bench.adversary.kinds import REQUESTS, SERVICES, Knowledge
from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.bench.adversary.worker_kinds import first_state, lie, sound_registration
from embomatrix.manager.control.plausibility import contradiction
from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.bounds import parsed
from embomatrix.rpc.wire.codec import ConvertError, each, inside
from embomatrix.rpc.wire.leases import LeaseResult
from embomatrix.rpc.wire.outcome import rollout_result_from_proto, rollout_result_to_proto
from embomatrix.rpc.wire.rollout import (
    batch_from_proto,
    batch_to_proto,
    checked_turns,
    rollout_to_proto,
    turn_from_proto,
    turns_to_proto,
)
from embomatrix.rpc.wire.run import (
    group_done_from_proto,
    lookahead_answer_from_proto,
    lookahead_entry_from_proto,
    lookahead_entry_to_proto,
    run_stats_from_proto,
    run_terms_from_proto,
    run_terms_to_proto,
)
from embomatrix.rpc.wire.run_log import (
    event_page_from_proto,
    explanation_from_proto,
    run_summary_from_proto,
    run_summary_to_proto,
)
from embomatrix.rpc.wire.session import (
    host_use_from_proto,
    host_use_to_proto,
    lease_from_proto,
    lease_progress_from_proto,
    lease_ref_from_proto,
    lease_result_from_proto,
    lease_result_to_proto,
    plan_cell_from_proto,
    resources_from_proto,
    resources_to_proto,
    run_info_from_proto,
    worker_info_from_proto,
    worker_info_to_proto,
    worker_state_from_proto,
    worker_state_to_proto,
)
from embomatrix.rpc.wire.tokens import role_from_proto, token_info_from_proto
from embomatrix.rpc.wire.training import training_report_from_proto, training_report_to_proto
from embomatrix.rpc.wire.values import Completed, Rollout, RolloutResult
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill, SkillCall
from embomatrix.skills.turns import EpisodePrefix

Use = Callable[[Any], object]
PLAN: Plan = (
    SkillCall(Skill.MOVE, object_index=1),
    SkillCall(Skill.PLACE, object_index=2, relation=PlaceRelation.INSIDE),
    SkillCall(Skill.GO_TO_ROOM, room_name="kitchen_0"),
    SkillCall(Skill.MOVE_FORWARD, yaw=0.5, distance=-1.0),
    SkillCall(Skill.COOK, object_index=1, source_index=2),
)
ROLLOUT = Rollout("r-1", "g-1", "sha256:" + "0" * 64, "open-fridge", PLAN, 3)
TURN = dataclasses.replace(ROLLOUT, prefix=EpisodePrefix(3, (1,), "sha256:" + "1" * 64))


def _again(convert: Callable[[Any], Any], back: Callable[[Any], Message]) -> Use:
    """Return a function that converts a message, writes the value, and converts the written message."""

    def use(message: Message) -> object:
        value = convert(message)
        written = back(value)
        assert convert(type(written).FromString(written.SerializeToString())) == value
        return value

    return use


def _session(message: worker_service_pb2.SessionRequest) -> object:
    results: tuple[LeaseResult, ...] = each("results", lease_result_from_proto, message.results)
    if message.HasField("state"):
        state = inside("state", worker_state_from_proto, message.state)
        again = worker_state_to_proto(state)
        worker_state_from_proto(type(again).FromString(again.SerializeToString()))
        results = (*results, *state.finished)
    for result in results:
        written = lease_result_to_proto(result)
        lease_result_from_proto(type(written).FromString(written.SerializeToString()))
        if isinstance(result.outcome, Completed):
            "".join((*result.outcome.final, result.outcome.trace_digest))  # parses the rest
            contradiction(result.outcome, ROLLOUT, PAPER)
            _log_row(result)
    return results


def _log_row(result: LeaseResult) -> None:
    """Write the result as the row of a batch, as the manager does, and read it as the trainer does."""
    row = rollout_result_to_proto(RolloutResult("r-1", "g-1", 1, 1, result.outcome)).SerializeToString()
    rollout_result_from_proto(types_pb2.RolloutResult.FromString(row))


def _heartbeat(message: worker_service_pb2.HeartbeatRequest) -> object:
    return (
        each("running", lease_ref_from_proto, message.running),
        each("progress", lease_progress_from_proto, message.progress),
        inside("host", _again(host_use_from_proto, host_use_to_proto), message.host),
    )


REQUEST_USES: Mapping[str, Use] = {
    "RegisterRequest": lambda message: inside(
        "resources", _again(resources_from_proto, resources_to_proto), message.resources
    ),
    "SessionRequest": _session,
    "HeartbeatRequest": _heartbeat,
    "OpenRunRequest": _again(run_terms_from_proto, run_terms_to_proto),
    "AnnounceLookaheadRequest": lambda message: each(
        "entries", _again(lookahead_entry_from_proto, lookahead_entry_to_proto), message.entries
    ),
    "ExecuteRequest": _again(batch_from_proto, batch_to_proto),
    "StepRequest": _again(
        lambda message: checked_turns(each("turns", turn_from_proto, message.turns)),
        lambda turns: turns_to_proto("run", turns),
    ),
    "ReportTrainingRequest": _again(
        training_report_from_proto, lambda report: training_report_to_proto("run", report)
    ),
    "IssueTokenRequest": lambda message: role_from_proto(message.role),
}
"""Conversions of the manager's servicers. Other requests have none."""


def _leases(message: worker_service_pb2.SessionResponse) -> object:
    each("acknowledged", lease_ref_from_proto, message.acknowledged)
    each("cancelled", lease_ref_from_proto, message.cancelled)
    return [lease.rollout.plan for lease in each("leases", lease_from_proto, message.leases)]


def _results(message: rollout_service_pb2.ExecuteResponse) -> object:
    return each("groups", group_done_from_proto, message.groups), _each_result(message)


def _each_result(message: rollout_service_pb2.ExecuteResponse | rollout_service_pb2.StepResponse) -> object:
    results = each("results", rollout_result_from_proto, message.results)
    for result in results:
        written = rollout_result_to_proto(result)
        rollout_result_from_proto(type(written).FromString(written.SerializeToString()))
    return results


ANSWER_USES: Mapping[str, Use] = {
    "SessionResponse": _leases,
    "ExecuteResponse": _results,
    "WaitExecutionResponse": _results,
    "StepResponse": _each_result,
    "AnnounceLookaheadResponse": lambda message: each(
        "answers", lookahead_answer_from_proto, message.answers
    ),
    "CloseRunResponse": lambda message: inside("stats", run_stats_from_proto, message.stats),
    "ListWorkersResponse": lambda message: each(
        "workers", _again(worker_info_from_proto, worker_info_to_proto), message.workers
    ),
    "ListRunsResponse": lambda message: each("runs", run_info_from_proto, message.runs),
    "GetPlanResponse": lambda message: each("cells", plan_cell_from_proto, message.cells),
    "GetRunResponse": _again(run_summary_from_proto, run_summary_to_proto),
    "ReadEventsResponse": event_page_from_proto,
    "ExplainRolloutResponse": explanation_from_proto,
    "ListTokensResponse": lambda message: each("tokens", token_info_from_proto, message.tokens),
}
"""Conversions of the clients. Other answers have none."""

MODULES = (worker_service_pb2, rollout_service_pb2, scene_service_pb2, admin_service_pb2)
ANSWERS: Mapping[str, type[Message]] = {
    f"{service.full_name.removeprefix(SERVICES)}/{method.name}": GetMessageClass(method.output_type)
    for module in MODULES
    for service in module.DESCRIPTOR.services_by_name.values()
    for method in service.methods
}
"""Type of the answer by SERVICE/CALL, of every call of the protocol."""


def _types(calls: Mapping[str, type[Message]], service: str) -> tuple[type[Message], ...]:
    return tuple(kind for call, kind in sorted(calls.items()) if call.startswith(service))


def _request(kinds: Sequence[type[Message]], data: bytes) -> object:
    kind = kinds[data[0] % len(kinds)] if data else kinds[0]
    message = parsed(kind, data[1:])
    return REQUEST_USES.get(kind.DESCRIPTOR.name, bool)(message)


def _answer(kinds: Sequence[type[Message]], data: bytes) -> object:
    kind = kinds[data[0] % len(kinds)] if data else kinds[0]
    return ANSWER_USES.get(kind.DESCRIPTOR.name, bool)(kind.FromString(data[1:]))


def _mutate(kinds: Sequence[type[Message]], data: bytes, rng: random.Random) -> bytes:
    """Return a message in which one field, its own or that of a part, is random, or now and then garbled bytes."""
    if not data or rng.random() < 0.2:
        return mutate_bytes(data, rng)
    kind = kinds[data[0] % len(kinds)]
    maker = MessageMaker(rng, ("a", "sha256:" + "0" * 64))
    try:
        message = kind.FromString(data[1:])
    except DecodeError:
        return mutate_bytes(data, rng)
    place = _some_part(message, rng)
    drawn = maker.any(type(place))
    fields = [field for field, _ in drawn.ListFields()]
    if fields:
        field = rng.choice(fields)
        if rng.random() < 0.7 and field.default_value != []:
            place.ClearField(field.name)
        chosen = type(place)()
        chosen.CopyFrom(drawn)
        for other in fields:
            if other is not field:
                chosen.ClearField(other.name)
        place.MergeFrom(chosen)
    return data[:1] + message.SerializeToString()


def _some_part(message: Message, rng: random.Random) -> Message:
    """Return the message or a message inside it."""
    while rng.random() < 0.7:
        parts: list[Message] = []
        for field, value in message.ListFields():
            if field.message_type is None or field.message_type.GetOptions().map_entry:
                continue
            parts += list(value) if field.default_value == [] else [value]
        if not parts:
            break
        message = rng.choice(parts)
    return message


def _sound() -> Mapping[str, list[Message]]:
    """Return sound messages by the name of their type."""
    rollout = rollout_to_proto(ROLLOUT)
    known = Knowledge("s-1", 1, "w-1", "run-1", rollouts=(rollout,))
    ref = worker_service_pb2.LeaseRef(lease_id="lease-1", lease_epoch=2)
    origin = worker_service_pb2.LeaseOrigin(run_id="run-1", batch_id="b-1", rollout_id="r-1", attempt=1)
    lease = worker_service_pb2.Lease(ref=ref, rollout=rollout, origin=origin, deadline_s=30.0)
    result = lie(lease)
    session = first_state(known)
    session.state.claims.add(ref=ref, origin=origin)
    session.state.running.append(ref)
    session.state.finished.append(result)
    failed = worker_service_pb2.LeaseResult(lease=ref)
    failed.infra_failure.code = types_pb2.INFRA_CODE_SLOT_CRASHED
    failed.infra_failure.message = "signal 11"
    session.results.extend([result, failed])
    beat = worker_service_pb2.HeartbeatRequest(session_id="s-1", session_epoch=1, running=[ref], load=0.5)
    beat.progress.add(ref=ref, steps=2)
    beat.host.cpu_share, beat.host.memory_mb = 0.5, 1024
    beat.log_lines.append("2026-11-21 14:00:11.482Z INFO    registered")
    delivered = types_pb2.RolloutResult(rollout_id="r-1", group_id="g-1", cursor=1, attempt=1)
    delivered.completed.CopyFrom(result.completed)
    answer = rollout_service_pb2.ExecuteResponse(results=[delivered])
    answer.groups.add(group_id="g-1", completed=1)
    turned = types_pb2.RolloutResult(rollout_id="r-1", group_id="g-1", attempt=1)
    turned.completed.CopyFrom(result.completed)
    turned.completed.observation.room = "kitchen_0"
    turned.completed.observation.changes.append("apple_1: on table_1 in kitchen_0")
    report = rollout_service_pb2.ReportTrainingRequest(run_id="run-1", phase="grpo", step=1)
    report.figures["reward"] = 0.5
    report.plans.add(task_id="t", text="move 1", advantage=0.1).steps.add(skill="move", ok=True)
    summary = admin_service_pb2.GetRunResponse()
    summary.run.run_id, summary.series.step_s = "run-1", 1.0
    summary.phases.add(phase="queue", count=1)
    return {
        "RegisterRequest": [sound_registration(known)],
        "SessionRequest": [session],
        "HeartbeatRequest": [beat],
        "OpenRunRequest": [
            rollout_service_pb2.OpenRunRequest(name="a", run_id="run-1", protocol_version=PROTOCOL_VERSION)
        ],
        "ExecuteRequest": [
            rollout_service_pb2.ExecuteRequest(run_id="run-1", batch_id="b-1", rollouts=[rollout])
        ],
        "StepRequest": [turns_to_proto("run-1", (TURN,))],
        "StepResponse": [rollout_service_pb2.StepResponse(results=[turned])],
        "ReportTrainingRequest": [report],
        "SessionResponse": [
            worker_service_pb2.SessionResponse(leases=[lease], acknowledged=[ref], cancelled=[ref])
        ],
        "ExecuteResponse": [answer],
        "GetRunResponse": [summary],
    }


def _seeds(kinds: Sequence[type[Message]]) -> list[bytes]:
    sound = _sound()
    found: list[bytes] = []
    for number, kind in enumerate(kinds):
        maker = MessageMaker(random.Random(7 + number), ("run-1", "sha256:" + "0" * 64))
        messages = [*sound.get(kind.DESCRIPTOR.name, []), kind(), maker.any(kind), maker.any(kind)]
        texts = [message.SerializeToString(deterministic=True) for message in messages]
        found += [bytes([number]) + text for text in texts if len(text) < 4_000]
    return found


def table() -> dict[str, Decoder]:
    """Return the decoders of this module by name."""
    found: dict[str, Decoder] = {}
    convert = {"rpc.wire.bounds:parsed"}
    rollouts = {f"rpc.wire.rollout:{name}" for name in ("_call_of", "rollout_from_proto", "write_rollout")}
    outcomes = {f"rpc.wire.outcome:{name}" for name in ("_step_of", "_steps_in", "write_completed")}
    reads = {
        "WorkerService": {*convert, *outcomes, "rpc.wire.outcome:_read_completed"},
        "RolloutService": {*convert, *rollouts},
    }
    for service in ("WorkerService", "RolloutService", "SceneService", "AdminService"):
        requests, answers = _types(REQUESTS, service), _types(ANSWERS, service)
        found[f"requests to {service}"] = Decoder(
            functools.partial(_request, requests),
            (ConvertError,),
            functools.partial(_seeds, requests),
            frozenset(reads.get(service, convert)),
            functools.partial(_mutate, requests),
        )
        found[f"answers of {service}"] = Decoder(
            functools.partial(_answer, answers),
            (ConvertError, DecodeError),
            functools.partial(_seeds, answers),
            frozenset({"rpc.wire.rollout:_read_rollout"} if service == "WorkerService" else set()),
            functools.partial(_mutate, answers),
        )
    return found
