"""Conversion of run terms, look-ahead, groups and counters to and from protobuf."""

import dataclasses
from typing import Final

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.reward.settings import PAPER, RewardSettings, RewardSettingsError
from embomatrix.rpc.wire.codec import ConvertError, converters, enum_numbers
from embomatrix.rpc.wire.values import (
    GroupDone,
    GroupPolicy,
    LookaheadAnswer,
    LookaheadEntry,
    RunStats,
    RunTerms,
    Warmth,
)

LEAST_WEIGHT: Final = 1e-3
"""Smallest weight of a run. Slot time is divided by it: a much smaller one makes turns that no number can hold."""
WARMTHS: Final = enum_numbers(Warmth, types_pb2.Warmth, "WARMTH")

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


def reward_settings_to_proto(reward: RewardSettings) -> types_pb2.RewardSettings | None:
    """Return None for the paper's coefficients: an absent field means the paper's."""
    return (
        None if reward is PAPER or reward == PAPER else types_pb2.RewardSettings(**dataclasses.asdict(reward))
    )


def reward_settings_from_proto(message: types_pb2.RewardSettings) -> RewardSettings:
    """Return the coefficients. Raise ConvertError for values that make no reward."""
    try:
        return RewardSettings(**{name: getattr(message, name) for name in RewardSettings.__slots__})
    except RewardSettingsError as error:
        raise ConvertError(error.field, error.problem) from error


run_terms_to_proto, _terms_from_proto = converters(
    RunTerms,
    rollout_service_pb2.OpenRunRequest,
    enums={"group_policy": enum_numbers(GroupPolicy, rollout_service_pb2.GroupPolicy, "GROUP_POLICY")},
    parts={"reward": (reward_settings_to_proto, reward_settings_from_proto)},
    absent={"group_policy": RunTerms().group_policy, "weight": RunTerms().weight, "reward": PAPER},
)
"""The first returns an OpenRun request with the terms alone."""


def run_terms_from_proto(message: rollout_service_pb2.OpenRunRequest) -> RunTerms:
    terms = _terms_from_proto(message)
    if message.rollout_deadline_s < 0:
        raise ConvertError("rollout_deadline_s", f"found {message.rollout_deadline_s}: expected 0 or more")
    if terms.weight < LEAST_WEIGHT:
        raise ConvertError(
            "weight", f"found {message.weight}: expected {LEAST_WEIGHT} or more, or 0 for the default"
        )
    return terms
