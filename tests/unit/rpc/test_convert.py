"""Values round-trip through protobuf, and malformed messages name their field."""

import dataclasses
import math
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.wire import outcome as convert_outcome
from embomatrix.rpc.wire import rollout as convert
from embomatrix.rpc.wire import run as convert_run
from embomatrix.rpc.wire import session as convert_session
from embomatrix.rpc.wire.bounds import MOST_EQUAL
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupDone,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    LookaheadAnswer,
    LookaheadEntry,
    Resources,
    Rollout,
    RolloutResult,
    RunStats,
    RunTerms,
    Timings,
    Warmth,
)
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import MAX_STEPS, SIGNATURES, Arg, PlaceRelation, Skill, SkillCall
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import Advice, EpisodePrefix, TurnObservation

NEWER = bytes.fromhex("f80705")
"""Field 127, a varint, as a later version of the protocol may add it to a message."""
UINT32 = st.integers(0, 2**32 - 1)
UINT64 = st.integers(0, 2**64 - 1)
SECONDS = st.floats(0, 1000)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
TEXTS = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)
NAMES = st.text("abcdefgh-0123", min_size=1, max_size=12)
VALUES = {
    Arg.OBJECT: st.integers(-(2**63), 2**63 - 1),
    Arg.SOURCE: st.integers(-(2**63), 2**63 - 1),
    Arg.RELATION: st.sampled_from(PlaceRelation),
    Arg.YAW: NUMBERS,
    Arg.DISTANCE: NUMBERS,
    Arg.ROOM: TEXTS,
}


def _call_of(skill):
    arguments = {arg.value: VALUES[arg] for arg in SIGNATURES[skill]}
    return st.builds(SkillCall, st.just(skill), **arguments)


CALLS = st.sampled_from(Skill).flatmap(_call_of)
ROLLOUTS = st.builds(
    Rollout,
    NAMES,
    NAMES,
    NAMES,
    NAMES,
    plan=st.lists(CALLS, max_size=5).map(tuple),
    seed=UINT64,
    render=st.booleans(),
)
TURNS = st.builds(
    lambda rollout, calls, failed, digest, sight, advise: dataclasses.replace(
        rollout,
        plan=tuple(calls),
        sight=sight,
        advise=advise,
        prefix=EpisodePrefix(
            len(calls) - 1, tuple(sorted(index for index in failed if index < len(calls) - 1)), digest
        ),
    ),
    ROLLOUTS,
    st.lists(CALLS, min_size=1, max_size=5),
    st.sets(st.integers(0, 4)),
    TEXTS,
    st.booleans(),
    st.booleans(),
)
OBSERVATIONS = st.builds(
    TurnObservation,
    TEXTS,
    st.lists(TEXTS, max_size=3).map(tuple),
    st.lists(TEXTS, max_size=3).map(tuple),
    st.booleans(),
    st.lists(UINT32, max_size=3).map(tuple),
    st.none() | st.builds(Advice, st.lists(CALLS, max_size=3).map(tuple), TEXTS),
)
REWARDS = st.builds(
    RewardBreakdown,
    NUMBERS,
    NUMBERS,
    NUMBERS,
    st.lists(st.builds(AtomResult, TEXTS, st.booleans()), max_size=4).map(tuple),
    st.booleans(),
)
STEPS = st.builds(Step, CALLS, st.none() | st.sampled_from(FailureReason), TEXTS)
COMPLETED = st.builds(
    Completed,
    REWARDS,
    st.lists(STEPS, max_size=3).map(tuple),
    st.lists(TEXTS, max_size=3).map(tuple),
    TEXTS,
    TEXTS,
    st.builds(Timings, SECONDS, SECONDS, SECONDS),
    st.booleans(),
    st.integers(0, 3),
    st.none() | OBSERVATIONS,
)
FAILURES = st.builds(InfraFailure, st.sampled_from(InfraCode), TEXTS, TEXTS)
RESULTS = st.builds(
    RolloutResult, NAMES, NAMES, UINT64, UINT32, COMPLETED | FAILURES | st.builds(Cancelled, TEXTS)
)
RESOURCES = st.builds(
    Resources,
    slots=st.integers(1, 512),
    cores=UINT32,
    memory_mb=UINT64,
    score=NUMBERS,
    gpu=TEXTS,
    vram_mb=UINT64,
    versions=st.dictionaries(NAMES, TEXTS, max_size=3),
    render_slots=UINT32,
    disk_mb=UINT64,
    labels=st.dictionaries(NAMES, TEXTS, max_size=3),
)


def _over_the_wire(message):
    return type(message).FromString(message.SerializeToString())


@given(CALLS)
def test_every_skill_call_round_trips(call):
    assert convert.skill_call_from_proto(_over_the_wire(convert.skill_call_to_proto(call))) == call


@given(st.lists(ROLLOUTS, max_size=4, unique_by=lambda rollout: rollout.rollout_id).map(tuple), NAMES, UINT64)
def test_batch_round_trips(rollouts, name, step):
    batch = Batch("run-1", name, step, rollouts)
    assert convert.batch_from_proto(_over_the_wire(convert.batch_to_proto(batch))) == batch


@given(st.lists(TURNS, min_size=1, max_size=4, unique_by=lambda turn: turn.rollout_id).map(tuple), NAMES)
def test_turns_round_trip(turns, run_id):
    message = _over_the_wire(convert.turns_to_proto(run_id, turns))
    assert message.run_id == run_id
    came = tuple(map(convert.turn_from_proto, message.turns))
    assert convert.checked_turns(came) == turns
    assert all(turn.is_turn for turn in came)


@given(TURNS)
def test_prefix_of_an_unparsed_turn_is_known_at_once(turn):
    unread = convert.unread_rollout(convert.rollout_to_proto(turn))
    assert unread.prefix == turn.prefix
    assert unread == turn


CALL = SkillCall(Skill.MOVE, object_index=1)


@pytest.mark.parametrize(
    ("prefix", "calls", "problem"),
    [
        (None, 1, "prefix: found no value"),
        (EpisodePrefix(2), 2, "prefix.length: found 2 of 2 calls: expected fewer"),
        (EpisodePrefix(0), 0, "prefix.length: found 0 of 0 calls: expected fewer"),
        (EpisodePrefix(2, (2,)), 3, "prefix.failed: found 2: expected rising indices below 2"),
        (EpisodePrefix(3, (1, 1)), 4, "prefix.failed: found 1, 1: expected rising indices below 3"),
        (EpisodePrefix(3, (1, 0)), 4, "prefix.failed: found 1, 0: expected rising indices below 3"),
        (EpisodePrefix(64), 65, "plan: found 65 elements: expected at most 64"),
        (EpisodePrefix(65), 64, "prefix.length: found 65: expected 0 to 64"),
        (EpisodePrefix(1, (), "x" * 4_001), 2, "prefix.digest: found 4,001 characters"),
    ],
)
def test_malformed_prefix_is_named(prefix, calls, problem):
    turn = convert.rollout_to_proto(Rollout("r", "g", "b", "t", (CALL,) * calls, 0, prefix=prefix))
    with pytest.raises(ConvertError) as caught:
        convert.turn_from_proto(turn)
    assert problem in str(caught.value)


@pytest.mark.parametrize("field", ["sight", "advise"])
def test_turn_that_only_looks_may_have_no_further_call(field):
    turn = Rollout("r", "g", "b", "t", (CALL,), 0, prefix=EpisodePrefix(1), **{field: True})
    assert convert.turn_from_proto(_over_the_wire(convert.rollout_to_proto(turn))) == turn
    beyond = convert.rollout_to_proto(dataclasses.replace(turn, prefix=EpisodePrefix(2)))
    with pytest.raises(ConvertError, match=r"found 2 of 1 calls: expected no more than the plan has"):
        convert.turn_from_proto(beyond)
    no_turn = convert.rollout_to_proto(dataclasses.replace(turn, prefix=None))
    with pytest.raises(ConvertError, match=f"{field}: found it without a prefix"):
        convert.rollout_from_proto(no_turn)


def test_repeated_turn_is_named():
    turn = Rollout("r", "g", "b", "t", (CALL,), 0, prefix=EpisodePrefix())
    with pytest.raises(ConvertError, match=r"turns\[1\].rollout_id: found 'r' a second time"):
        convert.checked_turns((turn, turn))


@given(RESULTS)
def test_results_of_every_outcome_round_trip(result):
    message = _over_the_wire(convert_outcome.rollout_result_to_proto(result))
    assert convert_outcome.rollout_result_from_proto(message) == result


@given(COMPLETED, SECONDS, NAMES, st.booleans())
def test_forwarded_result_carries_noted_fields(completed, queued_s, worker_id, warm):
    message = _over_the_wire(convert_outcome.completed_to_proto(completed))
    timings = Timings(queued_s, completed.timings.load_s, completed.timings.execute_s)
    came = convert_outcome.completed_from_proto(message)
    noted = came.noted(timings=timings, worker_id=worker_id, warm=warm)
    passed = convert_outcome.completed_from_proto(_over_the_wire(convert_outcome.completed_to_proto(noted)))
    assert passed == noted == dataclasses.replace(completed, timings=timings, worker_id=worker_id, warm=warm)


@given(COMPLETED, SECONDS, NAMES, st.booleans())
def test_unparsed_result_is_forwarded_like_a_parsed_one(completed, load_s, worker_id, warm):
    message = convert_outcome.completed_to_proto(completed)
    timings = Timings(load_s=load_s)
    unread = convert_outcome.unread_completed(message.SerializeToString(), timings=timings, warm=not warm)
    noted = unread.noted(worker_id=worker_id, warm=warm)
    read = convert_outcome.completed_from_proto(message).noted(
        timings=timings, worker_id=worker_id, warm=warm
    )
    assert convert_outcome.completed_to_proto(noted) == convert_outcome.completed_to_proto(read)
    assert (noted.timings, noted.worker_id, noted.warm) == (timings, worker_id, warm)
    assert noted == read  # and now it was looked at


@given(ROLLOUTS)
def test_unparsed_rollout_is_forwarded_like_a_parsed_one(rollout):
    message = convert.rollout_to_proto(rollout)
    unread = convert.unread_rollout(message)
    assert unread.bundle_digest == rollout.bundle_digest
    assert convert.rollout_to_proto(unread) == message
    assert unread == rollout
    assert dataclasses.replace(unread, seed=7) == dataclasses.replace(rollout, seed=7)


def test_malformed_unparsed_value_raises_on_first_access():
    unread = convert_outcome.unread_completed(
        types_pb2.Completed(trace_digest="t").SerializeToString(), timings=Timings(), warm=True
    )
    with pytest.raises(ConvertError, match="reward: found no value"):
        _ = unread.steps
    with pytest.raises(AttributeError, match="no attribute 'stops'"):
        _ = unread.stops


def test_unknown_fields_are_forwarded():
    rollout = convert.rollout_to_proto(Rollout("r", "g", "b", "t", (), 1)).SerializeToString()
    passed = convert.rollout_to_proto(
        convert.rollout_from_proto(types_pb2.Rollout.FromString(rollout + NEWER))
    )
    assert passed.SerializeToString() == rollout + NEWER


def test_changed_rollout_is_serialized_anew():
    came = convert.rollout_from_proto(convert.rollout_to_proto(Rollout("r", "g", "b", "t", (), 1)))
    assert convert.rollout_to_proto(dataclasses.replace(came, rollout_id="other")).rollout_id == "other"


@given(RESOURCES)
def test_resources_round_trip(resources):
    assert (
        convert_session.resources_from_proto(_over_the_wire(convert_session.resources_to_proto(resources)))
        == resources
    )


@given(st.builds(RunStats, *[UINT64] * len(RunStats.__slots__)))
def test_run_counters_round_trip(stats):
    assert convert_run.run_stats_from_proto(_over_the_wire(convert_run.run_stats_to_proto(stats))) == stats


@given(st.builds(LookaheadEntry, UINT64, NAMES, UINT32, st.booleans()))
def test_lookahead_entry_round_trips(entry):
    message = _over_the_wire(convert_run.lookahead_entry_to_proto(entry))
    assert convert_run.lookahead_entry_from_proto(message) == entry


@given(
    st.builds(
        RunTerms,
        st.sampled_from(GroupPolicy),
        st.floats(0.001, 1e6),
        st.integers(-(2**31), 2**31 - 1),
        st.floats(0, 1e6),
    )
)
def test_run_terms_round_trip(terms):
    message = _over_the_wire(convert_run.run_terms_to_proto(terms))
    assert convert_run.run_terms_from_proto(message) == terms


def test_empty_run_terms_are_the_defaults():
    assert convert_run.run_terms_from_proto(rollout_service_pb2.OpenRunRequest(name="old")) == RunTerms()


@pytest.mark.parametrize("weight", [-1.0, 1e-300, 9e-4])
def test_weight_without_a_usable_inverse_is_refused_with_its_field(weight):
    with pytest.raises(ConvertError, match=f"weight: found {weight}"):
        convert_run.run_terms_from_proto(rollout_service_pb2.OpenRunRequest(weight=weight))


@pytest.mark.parametrize(("weight", "meant"), [(0.0, 1.0), (1e-3, 1e-3), (2.5, 2.5)])
def test_weight_of_zero_stands_for_the_default(weight, meant):
    message = rollout_service_pb2.OpenRunRequest(weight=weight)
    assert convert_run.run_terms_from_proto(message).weight == meant


@given(st.builds(GroupDone, NAMES, UINT32, UINT32, UINT32))
def test_group_done_round_trips(done):
    assert convert_run.group_done_from_proto(_over_the_wire(convert_run.group_done_to_proto(done))) == done


@given(st.builds(LookaheadAnswer, NAMES, st.sampled_from(Warmth), NUMBERS, TEXTS))
def test_lookahead_answer_round_trips(answer):
    message = _over_the_wire(convert_run.lookahead_answer_to_proto(answer))
    assert convert_run.lookahead_answer_from_proto(message) == answer


@pytest.mark.parametrize("warmth", Warmth)
def test_every_warmth_round_trips(warmth):
    answer = LookaheadAnswer("sha256:0", warmth)
    message = _over_the_wire(convert_run.lookahead_answer_to_proto(answer))
    assert convert_run.lookahead_answer_from_proto(message) == answer


def test_every_wire_enum_value_has_a_member():
    assert set(convert.SKILL_KINDS) == set(Skill)
    assert len(convert.SKILL_KINDS) == len(types_pb2.SkillKind.keys()) - 1
    assert len(InfraCode) == len(types_pb2.InfraCode.keys()) - 1
    assert len(Warmth) == len(types_pb2.Warmth.keys()) - 1


def test_negative_object_index_round_trips():
    call = SkillCall(Skill.MOVE, object_index=-1)
    assert convert.skill_call_from_proto(_over_the_wire(convert.skill_call_to_proto(call))) == call


MOVE = types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_MOVE, object_index=1)
TURN_NAN = types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_TURN, yaw=math.nan)
PLACE_ABOVE = types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_PLACE, object_index=1, relation="above")


@pytest.mark.parametrize(
    ("calls", "field"),
    [
        ([types_pb2.SkillCall()], "rollouts[0].plan[0].skill"),
        ([MOVE, types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_MOVE)], "rollouts[0].plan[1].object_index"),
        (
            [types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_MOVE, object_index=1, yaw=0)],
            "rollouts[0].plan[0].yaw",
        ),
        ([TURN_NAN], "rollouts[0].plan[0].yaw"),
        ([PLACE_ABOVE], "rollouts[0].plan[0].relation"),
        ([MOVE] * (MAX_STEPS + 1), "rollouts[0].plan"),
    ],
)
def test_malformed_plan_names_the_field(calls, field):
    rollout = types_pb2.Rollout(rollout_id="r", group_id="g", bundle_digest="d", task_id="t", plan=calls)
    request = rollout_service_pb2.ExecuteRequest(run_id="run", batch_id="b", rollouts=[rollout])
    with pytest.raises(ConvertError) as caught:
        convert.batch_from_proto(request)
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{field}: ")


def test_two_rollouts_of_one_id_are_refused():
    rollout = types_pb2.Rollout(rollout_id="r", group_id="g", bundle_digest="d", task_id="t")
    request = rollout_service_pb2.ExecuteRequest(run_id="run", batch_id="b", rollouts=[rollout, rollout])
    with pytest.raises(ConvertError, match=r"rollouts\[1\].rollout_id: found 'r' a second time"):
        convert.batch_from_proto(request)


def test_result_without_an_outcome_is_refused():
    with pytest.raises(ConvertError, match="outcome: found no value"):
        convert_outcome.rollout_result_from_proto(types_pb2.RolloutResult(rollout_id="r"))


def test_completed_rollout_without_a_reward_is_refused_instead_of_scored_zero():
    message = types_pb2.RolloutResult(rollout_id="r", completed=types_pb2.Completed(trace_digest="x"))
    with pytest.raises(ConvertError, match=r"completed\.reward: found no value"):
        convert_outcome.rollout_result_from_proto(message)


def whole(**changed):
    fields = {"reward": types_pb2.Reward(format=0.5), "steps": [types_pb2.StepResult(call=MOVE)], **changed}
    return types_pb2.Completed(**fields)


@pytest.mark.parametrize("read", [convert_outcome.completed_from_proto, convert_outcome.checked_completed])
@pytest.mark.parametrize(
    ("message", "problem"),
    [
        (whole(reward=None), "reward: found no value"),
        (whole(reward=types_pb2.Reward(goal=math.nan)), "reward.goal: found nan"),
        (whole(timings=types_pb2.Timings(load_s=math.inf)), "timings.load_s: found inf"),
        (
            whole(timings=types_pb2.Timings(load_s=-math.inf, lease_s=math.inf)),
            "timings.load_s: found -inf",
        ),
        (
            whole(
                steps=[types_pb2.StepResult(call=MOVE), types_pb2.StepResult(call=MOVE, failure="gave_up")]
            ),
            r"steps\[1\].failure: found the unknown reason 'gave_up'",
        ),
        (whole(steps=[types_pb2.StepResult()]), r"steps\[0\].call.skill: found the unknown skill 0"),
    ],
)
def test_malformed_result_is_refused_by_reader_and_forwarder(read, message, problem):
    with pytest.raises(ConvertError, match=problem):
        read(message)


@pytest.mark.parametrize("seconds", [1.7e308, 86_401.0, -1.0])
def test_timings_below_zero_or_beyond_a_day_are_refused(seconds):
    with pytest.raises(ConvertError, match=r"execute_s: found .* expected 0 to 86400"):
        convert_outcome.timings_from_proto(types_pb2.Timings(execute_s=seconds))


@given(COMPLETED)
def test_checked_result_equals_the_parsed_one(completed):
    message = convert_outcome.completed_to_proto(completed)
    assert convert_outcome.checked_completed(message) == completed


def test_worker_without_slots_is_refused():
    with pytest.raises(ConvertError, match="slots: found 0"):
        convert_session.resources_from_proto(types_pb2.Resources(cores=4))


def padded(number: int) -> bytes:
    """A field that this version does not know, of 30 kB."""
    text = f"{number:030000d}".encode()
    return bytes.fromhex("fa07") + varint(len(text)) + text


def varint(number: int) -> bytes:
    low = bytes([number & 0x7F])
    return low if number < 0x80 else bytes([number & 0x7F | 0x80]) + varint(number >> 7)


def test_large_calls_and_steps_stay_in_no_cache():
    """Caches keep 65,536 of each: with unknown fields of 30 kB that would be four gigabytes."""
    tracemalloc.start()
    try:
        for number in range(200):
            call = types_pb2.SkillCall.FromString(MOVE.SerializeToString() + padded(number))
            rollout = types_pb2.Rollout(
                rollout_id="r", group_id="g", bundle_digest="d", task_id="t", plan=[call]
            )
            assert convert.rollout_from_proto(rollout).plan == (convert.skill_call_from_proto(MOVE),)
            step = types_pb2.StepResult(call=call, message="done")
            completed = types_pb2.Completed(reward=types_pb2.Reward(format=0.5), steps=[step])
            assert convert_outcome.completed_from_proto(completed).steps[0].message == "done"
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes < 1e6


@given(st.lists(st.tuples(st.sampled_from("gh"), st.integers(0, 2), st.integers(0, 1)), max_size=150))
def test_merged_rollouts_stand_for_all_rollouts(drawn):
    rollouts = [
        Rollout(f"{number}", group, "d", "t", (SkillCall(Skill.MOVE, object_index=index),), seed)
        for number, (group, index, seed) in enumerate(drawn)
    ]
    whole = convert.merged(rollouts)
    again = [
        dataclasses.replace(one, rollout_id=name, also=())
        for one in whole
        for name in (one.rollout_id, *one.also)
    ]
    assert sorted(again, key=lambda one: int(one.rollout_id)) == rollouts
    assert all(len(one.also) <= MOST_EQUAL for one in whole)
    assert len(whole) <= len(set(drawn)) + len(drawn) // (MOST_EQUAL + 1)
    batch = Batch("r", "b", 1, tuple(whole))
    assert convert.batch_from_proto(convert.batch_to_proto(batch)) == batch


def test_merged_rollouts_with_long_ids_fit_in_a_message():
    names = [f"{number:0256}" for number in range(20)]
    whole = convert.merged([Rollout(name, "g", "d", "t", (), 0) for name in names])
    assert [name for one in whole for name in (one.rollout_id, *one.also)] == names
    assert all(convert.rollout_from_proto(convert.rollout_to_proto(one)) == one for one in whole)


def test_id_that_occurs_twice_among_equal_rollouts_is_refused():
    batch = Batch("r", "b", 1, (Rollout("x", "g", "d", "t", (), 0, also=("y", "x")),))
    with pytest.raises(ConvertError, match="found 'x' a second time"):
        convert.batch_from_proto(convert.batch_to_proto(batch))
