"""Fidelity suite: known disagreements are found and counted; plans are reproducible and reach their quotas."""

from collections import Counter

import pytest
from tests.fakes.fidelity import clumsy, sloppy
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.sim.fidelity.compare import (
    Comparison,
    FidelityTrial,
    ModeRun,
    PlanKind,
    StepRun,
    compare,
    comparison_from_json,
    comparison_to_json,
    disagreement_to_json,
    objects_in,
    run_trial,
    trial_from_json,
    trial_to_json,
)
from embomatrix.sim.fidelity.plans import SolvedTask, TrialRequest, write_trials
from embomatrix.sim.fidelity.report import report_on
from embomatrix.sim.fidelity.sampler import ROUTINES, SKILLS
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill
from embomatrix.world.bundle import Bundle

DIGEST = "sha256:" + "0123456789abcdef" * 4
LAMP = "move table_lamp_1; toggle_on table_lamp_1; toggle_off table_lamp_1; move fridge_1"
CARRY = "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
KINDS = {PlanKind.ORACLE: 4, PlanKind.VALID: 6, PlanKind.PERTURBED: 6, PlanKind.FAILING: 4}


@pytest.fixture(scope="module")
def bundle():
    scene = kitchen_scene()
    return Bundle(scene, {task.task_id: task for task in kitchen_tasks(scene)})


@pytest.fixture(scope="module")
def cached(bundle):
    simulator = load_simulator(bundle)
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def examples(bundle, cached):
    return [SolvedTask(task, find_plan(cached, task)) for task in bundle.tasks.values()]


def trial_of(task, words):
    return FidelityTrial("t-0", DIGEST, "flat", task.task_id, PlanKind.VALID, 3, plan_of(task, words))


def compared(cached, other, words):
    task = task_over(cached.world.scene)
    return compare(cached, other, task, trial_of(task, words))


def test_mode_agrees_with_itself_in_every_step_and_atom(cached, bundle):
    other = load_simulator(bundle)
    comparison = compared(cached, other, CARRY)
    other.close()
    assert comparison.first_difference is None
    assert comparison.equal_steps == comparison.steps_of_either == 4
    assert comparison.equal_atoms == comparison.atoms_of_either
    assert "(ontop apple_1 countertop_1)" in comparison.equal_atoms


def test_first_different_step_is_reported_with_both_messages(cached, bundle):
    other = clumsy(bundle)
    comparison = compared(cached, other, LAMP)
    other.close()
    assert comparison.first_difference == 1
    assert (comparison.equal_steps, len(comparison.pairs), comparison.steps_of_either) == (1, 2, 4)
    record = disagreement_to_json(comparison)
    assert (record["step"], record["skill"]) == (2, "toggle_on")
    assert "switched table_lamp_1 on" in record["cached"]
    assert "blocks it" in record["physical"]


def test_atoms_of_one_mode_only_are_reported(cached, bundle):
    other = sloppy(bundle)
    comparison = compared(cached, other, CARRY)
    other.close()
    assert comparison.first_difference is None
    record = disagreement_to_json(comparison)
    assert "(ontop apple_1 countertop_1)" in record["only_cached"]
    assert "(inroom apple_1 kitchen_0)" in comparison.equal_atoms
    assert "step" not in record


def test_comparison_covers_objects_of_goal_and_calls(bundle):
    task = bundle.tasks[sorted(bundle.tasks)[0]]
    named = objects_in(task, plan_of(task, "move shelf_1"))
    assert "shelf_1" in named
    assert len(named) > 1
    for absent in ("move 59", "move -1", "move -999"):
        assert objects_in(task, (*plan_of(task, "move shelf_1"), *plan_of(task, absent))) == named


def run_of(*steps, cpu_s=1.0):
    return ModeRun(
        tuple(StepRun(skill, failure, "", seconds) for skill, failure, seconds in steps),
        frozenset(("(a)", "(b)")),
        cpu_s,
    )


def test_figures_agree_with_hand_computed_values():
    good, bad = None, FailureReason.FELL
    trial = FidelityTrial("t", DIGEST, "flat", "task", PlanKind.ORACLE, 0, ())
    one = Comparison(
        trial,
        300,
        run_of((Skill.OPEN, good, 0.001), (Skill.CLOSE, good, 0.001), (Skill.TURN, good, 0.001)),
        ModeRun(
            (StepRun(Skill.OPEN, good, "", 0.5), StepRun(Skill.CLOSE, bad, "", 0.5)), frozenset(("(a)",)), 2.0
        ),
    )
    other = Comparison(
        trial,
        60,
        run_of((Skill.PLACE, FailureReason.NO_FREE_POSE, 0.001)),
        run_of((Skill.PLACE, bad, 0.4), cpu_s=1.0),
    )
    report = report_on([one, other])
    assert (report.plans, report.scenes, report.succeeded) == (2, 1, 0.5)
    assert (report.atoms, report.atoms_equal) == (4, 0.75)
    assert (report.steps, report.steps_equal) == (3, pytest.approx(2 / 3))
    assert (report.steps_of_either, report.steps_equal_of_either) == (4, 0.5)
    assert (report.plans_equal, report.reasons_equal) == (0.5, pytest.approx(1 / 3))
    assert (report.plan_s, report.full_scene_plans, report.full_scene_plan_s) == (1.5, 1, 2.0)
    assert report.speedup_min == pytest.approx(500.0)
    by_skill = {item.skill: item for item in report.skills}
    assert (by_skill[Skill.CLOSE].unequal, by_skill[Skill.PLACE].unequal) == (1, 0)


def test_empty_suite_has_default_figures():
    report = report_on([])
    assert (report.plans, report.atoms_equal, report.steps_equal, report.speedup_min) == (0, 1.0, 1.0, 0.0)


def test_every_paper_skill_has_a_sampling_routine():
    assert set(ROUTINES) == set(SKILLS)


def test_equal_seeds_give_equal_trials_and_different_seeds_differ(cached, examples):
    first, again, other = (
        write_trials(cached, DIGEST, examples, TrialRequest(KINDS, {}, seed)) for seed in (0, 0, 1)
    )
    assert first == again
    assert [trial.plan for trial in first] != [trial.plan for trial in other]
    assert Counter(trial.kind for trial in first) == KINDS
    assert len({trial.trial_id for trial in first}) == len(first)


def test_trials_reach_every_quota_and_match_their_kind(cached, examples, bundle):
    quota = 6
    trials = write_trials(
        cached, DIGEST, examples, TrialRequest(KINDS, dict.fromkeys(SKILLS, quota), 5, extra=60)
    )
    calls = Counter()
    for trial in trials:
        run = run_trial(cached, bundle.tasks[trial.task_id], trial)
        if trial.kind in (PlanKind.VALID, PlanKind.ORACLE):
            assert run.ok, run.steps[-1]
            calls.update(step.skill for step in run.steps)
        elif trial.kind is PlanKind.FAILING:
            assert not run.ok
            assert len(run.steps) == len(trial.plan)
    assert all(calls[skill] >= quota for skill in SKILLS), calls


def test_trials_and_comparisons_round_trip_through_json(cached, examples, bundle):
    for trial in write_trials(cached, DIGEST, examples, TrialRequest(KINDS, {}, 2)):
        assert trial_from_json(trial_to_json(trial)) == trial
        found = compare(cached, cached, bundle.tasks[trial.task_id], trial)
        back = comparison_from_json(comparison_to_json(found))
        assert (back.trial, back.bodies, back.cached.atoms) == (trial, found.bodies, found.cached.atoms)
        assert [step.failure for step in back.physical.steps] == [
            step.failure for step in found.physical.steps
        ]
