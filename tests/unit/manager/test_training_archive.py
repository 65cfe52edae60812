"""Training reports in the archive of a run."""

import pytest

from embomatrix.manager.observe.training_archive import kept_training_from_proto, kept_training_to_proto
from embomatrix.manager.observe.training_reports import TrainingBook
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.training import RewardTiers, SampledPlan, SampledStep, TrainingReport

PLAN = SampledPlan(
    "t1",
    "tidy up",
    "move 3",
    RewardTiers(0.5, 0.2, 15.0, False),
    1.0,
    "",
    (SampledStep("move", True, "done"),),
)


def reported():
    book = TrainingBook()
    book.note("r1", "evening", TrainingReport("grpo", 1, {"reward": 1.0}), at_s=5.0)
    book.note("r1", "evening", TrainingReport("grpo", 2, {"entropy": 0.5}, (PLAN,)), at_s=6.0)
    return book


def test_curves_with_gaps_and_plans_survive_the_archive():
    detail = reported().copy_of("r1")
    again = kept_training_from_proto(kept_training_to_proto(detail), "r1", "evening")
    assert again.phases == detail.phases
    assert again.phases[0].figures == {"reward": [1.0, None], "entropy": [None, 0.5]}
    assert (again.plans, again.plans_step) == ([PLAN], 2)
    assert (again.run.name, again.run.step, again.run.reported_s) == ("evening", 2, 6.0)


def test_later_reports_do_not_change_a_copy():
    book = reported()
    copy = book.copy_of("r1")
    book.note("r1", "evening", TrainingReport("grpo", 3, {"reward": 3.0}), at_s=7.0)
    assert copy.phases[0].steps == [1, 2]
    assert copy.phases[0].figures["reward"] == [1.0, None]
    assert book.copy_of("r9") is None


def test_lists_of_unequal_length_or_too_many_phases_are_refused():
    message = kept_training_to_proto(reported().copy_of("r1"))
    message.phases[0].curves[0].values.append(1.0)
    with pytest.raises(
        ConvertError, match=r"phases\[0\].curves\['reward'\]: found 3 values: expected one for"
    ):
        kept_training_from_proto(message, "r1", "")
    del message.phases[0].curves[0].values[-1]
    for _ in range(4):
        message.phases.add(phase="more")
    with pytest.raises(ConvertError, match="phases: found 5 elements: expected at most 4"):
        kept_training_from_proto(message, "r1", "")
