"""Training reports round-trip within their limits."""

import pytest

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.training import (
    FIGURES,
    PLANS,
    TEXT_CHARS,
    TURN_CHARS,
    TURNS,
    RewardTiers,
    SampledPlan,
    SampledStep,
    SampledTurn,
    TrainingReport,
    training_report_from_proto,
    training_report_to_proto,
)

STEPS = (
    SampledStep("move", True, "went to the table", "move 3"),
    SampledStep("open", False, "no free hand", "open 3"),
)
SOLVED = SampledPlan("t1", "tidy up", "move 3", RewardTiers(0.5, 0.4, 15.0, False), -0.7, "", STEPS)
LOST = SampledPlan("t1", "tidy up", "move 3", None, 0.0, "worker_lost: it went away")
EPISODE = SampledPlan(
    *("t1", "tidy up", "move 3\nopen 3", None, 0.5, "", STEPS),
    turns=(SampledTurn("move 3", "stands at table 3", 1), SampledTurn("open 3", "failed", 1)),
    opening="Robot: kitchen_0",
    end="calls",
)
REPORT = TrainingReport(
    "grpo", 7, {"reward": 1.25, "success_by_category/compound": 0.5}, (SOLVED, LOST, EPISODE)
)


def test_training_report_round_trips():
    message = pb.ReportTrainingRequest.FromString(training_report_to_proto("r1", REPORT).SerializeToString())
    assert (message.run_id, training_report_from_proto(message)) == ("r1", REPORT)


def test_long_or_malformed_model_text_is_cut_before_sending():
    plan = SampledPlan("t1", "tidy up", "\ud83c" + "x" * 9000, None, 0.0)
    decoded = training_report_from_proto(
        training_report_to_proto("r1", TrainingReport("grpo", 1, plans=(plan,)))
    )
    assert decoded.plans[0].text == "?" + "x" * (TEXT_CHARS - 1)


def test_long_episode_is_cut_before_sending():
    turns = (SampledTurn("move 3" * 1000, "stands" * 1000, 1),) * (TURNS + 5)
    plan = SampledPlan("t1", "tidy up", "", None, 0.0, turns=turns, opening="x" * 9000)
    sent = training_report_to_proto("r1", TrainingReport("grpo", 1, plans=(plan,)))
    (cut,) = training_report_from_proto(sent).plans
    assert (len(cut.turns), len(cut.opening)) == (TURNS, TEXT_CHARS)
    assert {(len(turn.answer), len(turn.observation)) for turn in cut.turns} == {(TURN_CHARS, TURN_CHARS)}


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (pb.ReportTrainingRequest(step=1), "phase"),
        (pb.ReportTrainingRequest(phase="x" * 65), "phase"),
        (pb.ReportTrainingRequest(phase="grpo", figures={"reward": float("nan")}), "reward"),
        (pb.ReportTrainingRequest(phase="grpo", figures={"": 1.0}), "figures"),
        (
            pb.ReportTrainingRequest(
                phase="grpo", figures={str(number): 0.0 for number in range(FIGURES + 1)}
            ),
            "figures",
        ),
        (pb.ReportTrainingRequest(phase="grpo", plans=[pb.SampledPlan()] * (PLANS + 1)), "plans"),
        (
            pb.ReportTrainingRequest(phase="grpo", plans=[pb.SampledPlan(text="x" * (TEXT_CHARS + 1))]),
            r"plans\[0\].text",
        ),
        (
            pb.ReportTrainingRequest(
                phase="grpo",
                plans=[pb.SampledPlan(turns=[pb.SampledTurn(), pb.SampledTurn(answer="x" * 2001)])],
            ),
            r"plans\[0\].turns\[1\].answer",
        ),
        (
            pb.ReportTrainingRequest(
                phase="grpo", plans=[pb.SampledPlan(reward=pb.RewardTiers(goal=float("inf")))]
            ),
            r"plans\[0\].reward.goal",
        ),
    ],
)
def test_report_beyond_its_bounds_is_refused_by_its_field(message, field):
    with pytest.raises(ConvertError, match=field):
        training_report_from_proto(message)
