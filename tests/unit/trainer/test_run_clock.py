"""Clock of a run: remaining time over all phases, and the warning when it is late."""

import io

import pytest
from rich.console import Console

from embomatrix.cli.demo import EVALUATE_EVERY, GRPO_STEPS, IMITATION_STEPS
from embomatrix.trainer.config.settings import EvaluationSettings
from embomatrix.trainer.config.typical_times import evaluations_during, typical_seconds
from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.logging.run_clock import Phase, PhaseTime, RunClock


def clock_with(*, imitation=None, grpo=None, evaluation=None, **options):
    phases = {Phase.IMITATION: imitation, Phase.GRPO: grpo, Phase.EVALUATION: evaluation}
    known = {phase: each for phase, each in phases.items() if each is not None}
    return RunClock(known, began_s=0.0, samples={"before": 10, "after": 10}, plans=40, **options)


def test_later_phases_are_as_slow_as_the_measured_one():
    clock = clock_with(
        imitation=PhaseTime(typical_s=100.0),
        grpo=PhaseTime(typical_s=400.0),
        evaluation=PhaseTime(typical_s=20.0),
    )
    assert clock.left_s() is None, "nothing is measured yet"
    clock.note(Phase.IMITATION, 0.25, now_s=50.0)
    assert clock.left_s() == pytest.approx(150.0 + 2 * 400.0 + 2 * 20.0)


def test_remaining_time_of_a_measured_phase_follows_its_own_speed():
    clock = clock_with(imitation=PhaseTime(typical_s=10.0), grpo=PhaseTime(typical_s=100.0))
    clock.note(Phase.IMITATION, 1.0, now_s=10.0)
    clock.note(Phase.GRPO, 0.5, now_s=210.0)
    assert clock.left_s() == pytest.approx(200.0)


def test_slow_first_steps_of_a_phase_are_no_measure_of_its_speed():
    clock = clock_with(imitation=PhaseTime(typical_s=100.0), evaluation=PhaseTime(typical_s=20.0))
    clock.note(Phase.IMITATION, 0.01, now_s=30.0)
    assert clock.left_s() is None
    clock.note(Phase.IMITATION, 1.0, now_s=100.0)
    clock.note(Phase.EVALUATION, 0.01, now_s=130.0)
    assert clock.left_s() == pytest.approx(0.99 * 20.0)


def test_budget_of_time_is_the_same_on_a_slow_machine():
    clock = clock_with(imitation=PhaseTime(typical_s=10.0), grpo=PhaseTime(budget_s=300.0))
    clock.note(Phase.IMITATION, 0.5, now_s=50.0)
    assert clock.left_s() == pytest.approx(50.0 + 300.0)


def test_model_without_typical_times_has_no_remaining_time_until_each_phase_has_run():
    clock = clock_with(imitation=PhaseTime(), grpo=PhaseTime())
    clock.note(Phase.IMITATION, 0.5, now_s=60.0)
    assert clock.left_s() is None
    clock.note(Phase.IMITATION, 1.0, now_s=120.0)
    clock.note(Phase.GRPO, 0.1, now_s=150.0)
    assert clock.left_s() == pytest.approx(270.0)


def test_resumed_phase_counts_from_its_beginning():
    clock = clock_with(grpo=PhaseTime(share=0.5))
    clock.note(Phase.GRPO, 0.75, now_s=25.0)
    assert clock.left_s() == pytest.approx(25.0)


def test_evaluations_before_and_after_grpo_are_one_phase():
    clock = clock_with(evaluation=PhaseTime())
    clock.note_evaluation("before", 1, 2, now_s=10.0)
    clock.note_evaluation("before", 2, 2, now_s=20.0)
    assert clock.left_s() == pytest.approx(20.0)
    clock.note_evaluation("after", 1, 2, now_s=30.0)
    clock.note_evaluation("after", 2, 2, now_s=40.0)
    assert clock.left_s() == 0.0


def test_late_run_is_reported_once():
    clock = clock_with(warn_after_s=60.0)
    assert [clock.is_late(now_s) for now_s in (59.0, 61.0, 62.0)] == [False, True, False]
    assert not clock_with().is_late(1e9)


def test_display_shows_the_time_of_the_whole_run_and_the_warning_beside_it():
    seen = io.StringIO()
    clock = RunClock(
        {Phase.IMITATION: PhaseTime(budget_s=90.0), Phase.GRPO: PhaseTime(budget_s=300.0)},
        began_s=0.0,
        warn_after_s=1e-9,
    )
    with LineDisplay(Console(file=seen, width=400), clock) as display:
        display.imitation(ImitationProgress(step=5, share=1 / 3, loss=1.5))
    assert (
        "warning: the run takes longer than announced, 6 min 00 s of the run left. It goes on."
        in seen.getvalue()
    )
    assert "imitation 33%, 6 min 00 s of the run left: step 5, loss 1.500" in seen.getvalue()


def test_demo_takes_the_minutes_that_the_readme_says():
    settings = EvaluationSettings(every=EVALUATE_EVERY)
    assert evaluations_during(settings, GRPO_STEPS) == 1
    assert evaluations_during(EvaluationSettings(every=70), 420, begun_at=141) == 3
    assert evaluations_during(EvaluationSettings(), GRPO_STEPS) == 0
    assert 10 < typical_seconds(IMITATION_STEPS, GRPO_STEPS, 200 * (2 * 10 + 1 * 4)) / 60 <= 11
