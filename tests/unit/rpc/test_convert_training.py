"""Training reports round-trip within their limits."""

import pytest

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.training import (
    FIGURES,
    PLANS,
    TEXT_CHARS,
    RewardTiers,
    SampledPlan,
    SampledStep,
    TrainingReport,
    training_report_from_proto,
    training_report_to_proto,
)

STEPS = (SampledStep("move", True, "went to the table"), SampledStep("open", False, "no free hand"))
SOLVED = SampledPlan("t1", "tidy up", "move 3", RewardTiers(0.5, 0.4, 15.0, False), -0.7, "", STEPS)
LOST = SampledPlan("t1", "tidy up", "move 3", None, 0.0, "worker_lost: it went away")
REPORT = TrainingReport("grpo", 7, {"reward": 1.25, "success_by_category/compound": 0.5}, (SOLVED, LOST))


def test_training_report_round_trips():
    message = pb.ReportTrainingRequest.FromString(training_report_to_proto("r1", REPORT).SerializeToString())
    assert (message.run_id, training_report_from_proto(message)) == ("r1", REPORT)


def test_long_or_malformed_model_text_is_cut_before_sending():
    plan = SampledPlan("t1", "tidy up", "\ud83c" + "x" * 9000, None, 0.0)
    decoded = training_report_from_proto(
        training_report_to_proto("r1", TrainingReport("grpo", 1, plans=(plan,)))
    )
    assert decoded.plans[0].text == "?" + "x" * (TEXT_CHARS - 1)


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
                phase="grpo", plans=[pb.SampledPlan(reward=pb.RewardTiers(goal=float("inf")))]
            ),
            r"plans\[0\].reward.goal",
        ),
    ],
)
def test_report_beyond_its_bounds_is_refused_by_its_field(message, field):
    with pytest.raises(ConvertError, match=field):
        training_report_from_proto(message)
