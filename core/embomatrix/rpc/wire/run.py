"""What a run asks and is told: terms, look-ahead, groups and counters, to wire messages and back."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.reward.settings import PAPER, RewardSettings, RewardSettingsError
from embomatrix.rpc.wire.rollout import ConvertError, finite, required
from embomatrix.rpc.wire.values import (
    GroupDone,
    GroupPolicy,
    LookaheadAnswer,
    LookaheadEntry,
    RunStats,
    RunTerms,
    Warmth,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.proto.v1 import admin_service_pb2, worker_service_pb2

    _Scored = rollout_service_pb2.OpenRunRequest | worker_service_pb2.Lease | admin_service_pb2.RunInfo

_WARMTHS: Final[Mapping[Warmth, types_pb2.Warmth.ValueType]] = {
    warmth: types_pb2.Warmth.Value(f"WARMTH_{warmth.name}") for warmth in Warmth
}
_WARMTH_VALUES: Final = {number: warmth for warmth, number in _WARMTHS.items()}
_POLICIES: Final[Mapping[GroupPolicy, rollout_service_pb2.GroupPolicy.ValueType]] = {
    policy: rollout_service_pb2.GroupPolicy.Value(f"GROUP_POLICY_{policy.name}") for policy in GroupPolicy
}
_POLICY_VALUES: Final = {
    rollout_service_pb2.GROUP_POLICY_UNSPECIFIED: RunTerms().group_policy,
    **{number: policy for policy, number in _POLICIES.items()},
}


def lookahead_entry_to_proto(entry: LookaheadEntry) -> rollout_service_pb2.LookaheadEntry:
    return rollout_service_pb2.LookaheadEntry(
        step=entry.step, bundle_digest=entry.bundle_digest, count=entry.count, render=entry.render
    )


def lookahead_entry_from_proto(message: rollout_service_pb2.LookaheadEntry) -> LookaheadEntry:
    digest = required("bundle_digest", message.bundle_digest)
    return LookaheadEntry(message.step, digest, message.count, message.render)


def lookahead_answer_to_proto(answer: LookaheadAnswer) -> rollout_service_pb2.LookaheadAnswer:
    return rollout_service_pb2.LookaheadAnswer(
        bundle_digest=answer.bundle_digest,
        warmth=warmth_to_proto(answer.warmth),
        eta_s=answer.eta_s,
        reason=answer.reason,
    )


def lookahead_answer_from_proto(message: rollout_service_pb2.LookaheadAnswer) -> LookaheadAnswer:
    warmth = warmth_from_proto(message.warmth)
    return LookaheadAnswer(message.bundle_digest, warmth, finite("eta_s", message.eta_s), message.reason)


def group_done_to_proto(done: GroupDone) -> rollout_service_pb2.GroupDone:
    return rollout_service_pb2.GroupDone(**{name: getattr(done, name) for name in GroupDone.__slots__})


def group_done_from_proto(message: rollout_service_pb2.GroupDone) -> GroupDone:
    return GroupDone(
        required("group_id", message.group_id), message.completed, message.infra_failures, message.cancelled
    )


def run_terms_to_proto(terms: RunTerms) -> rollout_service_pb2.OpenRunRequest:
    """The part of a request to open a run that says what the run asks for."""
    return rollout_service_pb2.OpenRunRequest(
        group_policy=_POLICIES[terms.group_policy],
        weight=terms.weight,
        priority=terms.priority,
        rollout_deadline_s=terms.rollout_deadline_s,
        verified=terms.verified,
        reward=reward_settings_to_proto(terms.reward),
    )


def run_terms_from_proto(message: rollout_service_pb2.OpenRunRequest) -> RunTerms:
    policy = _POLICY_VALUES.get(message.group_policy)
    if policy is None:
        raise ConvertError("group_policy", f"{message.group_policy} is no known policy: leave it out")
    for field in ("weight", "rollout_deadline_s"):
        if finite(field, getattr(message, field)) < 0:
            raise ConvertError(field, f"is {getattr(message, field)}: it can't be below 0")
    # A message without a weight has 0 there.
    return RunTerms(
        policy,
        message.weight or 1.0,
        message.priority,
        message.rollout_deadline_s,
        message.verified,
        reward_settings_of(message),
    )


def reward_settings_to_proto(reward: RewardSettings) -> types_pb2.RewardSettings | None:
    """None for the paper's, which are every worker's defaults: the field stays away."""
    return (
        None if reward is PAPER or reward == PAPER else types_pb2.RewardSettings(**dataclasses.asdict(reward))
    )


def reward_settings_of(message: _Scored) -> RewardSettings:
    """What the message's field ``reward`` asks for; the paper's where it is absent. ConvertError for what is no reward."""
    if not message.HasField("reward"):
        return PAPER
    told = message.reward
    try:
        return RewardSettings(
            told.unparsable, told.format, told.relevance_per_object, told.relevance_limit, told.goal
        )
    except RewardSettingsError as error:
        raise ConvertError(f"reward.{error.field}", error.problem) from error


def warmth_to_proto(warmth: Warmth) -> types_pb2.Warmth.ValueType:
    return _WARMTHS[warmth]


def warmth_from_proto(number: types_pb2.Warmth.ValueType) -> Warmth:
    warmth = _WARMTH_VALUES.get(number)
    if warmth is None:
        raise ConvertError("warmth", f"{number} is no known value: is the sender newer than this side?")
    return warmth


def run_stats_to_proto(stats: RunStats) -> rollout_service_pb2.RunStats:
    return rollout_service_pb2.RunStats(**{name: getattr(stats, name) for name in RunStats.__slots__})


def run_stats_from_proto(message: rollout_service_pb2.RunStats) -> RunStats:
    return RunStats(**{name: getattr(message, name) for name in RunStats.__slots__})
