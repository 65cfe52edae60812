"""Story and totals of a run."""

from embomatrix.manager.observe.run_story import run_story
from embomatrix.manager.observe.run_totals import Aim, TotalUnit, run_totals
from embomatrix.manager.observe.training_reports import Curves, TrainingDetail, TrainingView
from embomatrix.rpc.wire.run_log import (
    EventKind,
    PhaseSummary,
    RolloutPhase,
    RunEvent,
    RunSeries,
    RunSummary,
    RunWorker,
)
from embomatrix.rpc.wire.values import RunInfo, RunStats

DAY_S = 1_790_000_000.0
"""2026-09-21 14:13:20 UTC."""


def summary(*, closed_s=DAY_S + 90.0, completed=(30, 0, 10), stats=None, failures=(), waits_for=""):
    phases = {phase: PhaseSummary() for phase in RolloutPhase}
    phases[RolloutPhase.QUEUE] = PhaseSummary(40, 1.0, 0.02, 0.05, 0.1)
    phases[RolloutPhase.EXECUTE] = PhaseSummary(40, 3.0, 0.07, 0.1, 0.2)
    run = RunInfo("r1", "evening", stats or RunStats(), 3, DAY_S, closed_s, waits_for=waits_for)
    workers = (RunWorker("a", 30, 0, 2.0), RunWorker("b", 10, 2, 1.0), RunWorker("idle"))
    series = RunSeries(2.0, completed, (0, 2, 0))
    return RunSummary(run, phases, workers, series, failures, 1.0, PhaseSummary(), PhaseSummary(), 0, "0.1.0")


def training(steps=20):
    view = TrainingView("r1", "evening", "grpo", steps, DAY_S, steps)
    figures = {"reward": [float(step) for step in range(steps)], "success": [None] * steps}
    phases = [
        Curves("imitation", [10, 20, 30], {"loss": [2.0, 1.0, 0.5]}),
        Curves("success before GRPO", [0], {"all": [0.21]}),
        Curves("grpo", list(range(1, steps + 1)), figures),
        Curves("success after GRPO", [0], {"all": [0.55]}),
    ]
    return TrainingDetail(view, phases)


def total(totals, name):
    (found,) = [one for one in totals if one.name == name]
    return found.value


def test_story_of_a_closed_run_names_time_outcomes_speed_and_scenes():
    failed = [RunEvent(n, DAY_S, EventKind.FAILED, code="slot_crashed") for n in range(2)]
    failed.append(RunEvent(3, DAY_S, EventKind.FAILED, code="timeout"))
    stats = RunStats(infra_failures=1, redispatched=2, prewarm_hits=9, prewarm_misses=1, steps=100)
    assert run_story(summary(stats=stats, failures=tuple(failed))) == [
        "The run evening was open from 2026-09-21 14:13:20 UTC to 2026-09-21 14:14:50 UTC, for 90 s.",
        "2 workers completed 40 rollouts; 1 rollout ended in an infrastructure failure.",
        "Of the latest 3 failed attempts, 2 had the reason slot_crashed.",
        "Rollouts were re-dispatched 2 times, after a lease that failed, expired or was withdrawn.",
        "While there was work, 10.0 rollouts were completed per second. Half of them executed within 70 ms, "
        "99 % within 200 ms.",
        "Most of a rollout's time, 75%, passed executing plans.",
        "9 of 10 scenes were loaded before their batch came.",
    ]


def test_story_tells_rollouts_that_ended_without_an_attempt_from_failed_attempts():
    ended = [RunEvent(n, DAY_S, EventKind.ENDED, code="scene_load_failed") for n in range(3)]
    crashed = RunEvent(9, DAY_S, EventKind.FAILED, code="slot_crashed")
    stats = RunStats(infra_failures=3)
    without = run_story(summary(stats=stats, failures=tuple(ended)))
    assert "Of the latest 3 failed rollouts, 3 had the reason scene_load_failed." in without
    both = run_story(summary(stats=stats, failures=(*ended, crashed)))
    assert "One attempt failed, with the reason slot_crashed." in both


def test_story_of_an_open_run_without_work_says_what_it_waits_for():
    empty = summary(closed_s=0.0, completed=(), waits_for="no worker is connected")
    assert run_story(empty)[:3] == [
        "The run evening has been open since 2026-09-21 14:13:20 UTC; 3 rollouts wait or run.",
        "No connected worker can execute some of its rollouts: no worker is connected.",
        "No rollout has an outcome.",
    ]


def test_long_and_rounded_durations_are_told_in_fitting_units():
    five_days = summary(closed_s=DAY_S + 5 * 86_400.0)
    assert run_story(five_days)[0].endswith("for 5 days.")
    almost_a_second = summary(closed_s=DAY_S + 0.99999)
    assert run_story(almost_a_second)[0].endswith("for 1 s.")


def test_counters_of_leases_are_not_told_as_rollouts():
    found = run_totals(summary(stats=RunStats(redispatched=7)))
    assert total(found, "re-dispatches") == 7


def test_story_of_training_compares_first_and_last_steps_and_held_out_tasks():
    assert run_story(summary(), training())[-3:] == [
        "Its trainer reported 30 steps of imitation, 20 steps of GRPO.",
        "The mean reward was 4.50 in the first 10 steps and 14.50 in the last.",
        "Success on held-out tasks was 21% before GRPO and 55% after it.",
    ]
    assert run_story(summary(), training(1))[-2] == (
        "Its trainer reported 30 steps of imitation, 1 step of GRPO."
    ), "it has no two ends"


def test_scene_of_a_single_demand_is_told_in_the_singular():
    late = run_story(summary(stats=RunStats(prewarm_misses=1, prewarm_wasted=1)))
    assert late[-1] == "Its scene was not loaded before the batch came; 1 loaded scene had no use."


def test_totals_have_one_order_and_no_value_where_nothing_was_measured():
    plain, trained = run_totals(summary()), run_totals(summary(), training())
    assert [one.name for one in trained][: len(plain)] == [one.name for one in plain]
    assert len({one.name for one in trained}) == len(trained)
    assert total(plain, "throughput while there was work") == 10.0
    assert total(plain, "workers") == 2
    assert total(plain, "manager overhead") == 0.25
    assert total(plain, "prewarm hits") is None
    assert total(trained, "reward, latest steps") == 14.5
    assert total(trained, "success, latest steps") is None
    assert total(trained, "held-out success after GRPO") == 0.55
    failures = next(one for one in plain if one.name == "infrastructure failures")
    assert (failures.unit, failures.aim) == (TotalUnit.COUNT, Aim.DOWN)


def test_totals_of_a_run_without_work_have_no_rates():
    found = run_totals(summary(closed_s=0.0, completed=()))
    assert total(found, "throughput while there was work") is None
    assert total(found, "length") == 0.0
