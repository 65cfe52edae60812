"""Conversion of run terms, look-ahead, groups and counters to and from protobuf."""

import dataclasses
from collections.abc import Mapping
from typing import Final

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.reward.settings import PAPER, RewardSettings, RewardSettingsError
from embomatrix.rpc.wire.codec import ConvertError, converters, enum_member, enum_numbers, finite, inside
from embomatrix.rpc.wire.values import (
    GroupDone,
    GroupPolicy,
    LookaheadAnswer,
    LookaheadEntry,
    RunStats,
    RunTerms,
    Warmth,
)

WARMTHS: Final = enum_numbers(Warmth, types_pb2.Warmth, "WARMTH")
_POLICIES: Final = enum_numbers(GroupPolicy, rollout_service_pb2.GroupPolicy, "GROUP_POLICY")
_POLICY_VALUES: Final[Mapping[int, GroupPolicy]] = {
    rollout_service_pb2.GROUP_POLICY_UNSPECIFIED: RunTerms().group_policy,
    **{number: policy for policy, number in _POLICIES.items()},
}

lookahead_entry_to_proto, lookahead_entry_from_proto = converters(
    LookaheadEntry, rollout_service_pb2.LookaheadEntry, required_names=("bundle_digest",)
)
lookahead_answer_to_proto, lookahead_answer_from_proto = converters(
    LookaheadAnswer, rollout_service_pb2.LookaheadAnswer, enums={"warmth": WARMTHS}
)
group_done_to_proto, group_done_from_proto = converters(
    GroupDone, rollout_service_pb2.GroupDone, required_names=("group_id",)
)
run_stats_to_proto, run_stats_from_proto = converters(RunStats, rollout_service_pb2.RunStats)


def run_terms_to_proto(terms: RunTerms) -> rollout_service_pb2.OpenRunRequest:
    """Return an OpenRun request with the terms alone."""
    return rollout_service_pb2.OpenRunRequest(
        group_policy=_POLICIES[terms.group_policy],
        weight=terms.weight,
        priority=terms.priority,
        rollout_deadline_s=terms.rollout_deadline_s,
        verified=terms.verified,
        reward=reward_settings_to_proto(terms.reward),
    )


def run_terms_from_proto(message: rollout_service_pb2.OpenRunRequest) -> RunTerms:
    policy = enum_member("group_policy", _POLICY_VALUES, message.group_policy)
    for field in ("weight", "rollout_deadline_s"):
        if finite(field, getattr(message, field)) < 0:
            raise ConvertError(field, f"found {getattr(message, field)}: expected 0 or more")
    # An unset weight reads as 0.
    return RunTerms(
        policy,
        message.weight or 1.0,
        message.priority,
        message.rollout_deadline_s,
        message.verified,
        inside("reward", reward_settings_from_proto, message.reward) if message.HasField("reward") else PAPER,
    )


def reward_settings_to_proto(reward: RewardSettings) -> types_pb2.RewardSettings | None:
    """Return None for the paper's coefficients: an absent field means the paper's."""
    return (
        None if reward is PAPER or reward == PAPER else types_pb2.RewardSettings(**dataclasses.asdict(reward))
    )


def reward_settings_from_proto(message: types_pb2.RewardSettings) -> RewardSettings:
    """Return the coefficients. Raise ConvertError for values that make no reward."""
    try:
        return RewardSettings(
            message.unparsable,
            message.format,
            message.relevance_per_object,
            message.relevance_limit,
            message.goal,
        )
    except RewardSettingsError as error:
        raise ConvertError(error.field, error.problem) from error
