"""`bench fidelity`: a dead process costs one trial, an interrupted suite resumes."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.fidelity import clumsy, dying, hanging, raising
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.fidelity.page import figures_of
from embomatrix.bench.fidelity.pool import LOST, FidelityPool, Modes
from embomatrix.bench.fidelity.suite import (
    DISAGREEMENTS_FILE,
    PLANS_FILE,
    RESULTS_FILE,
    FidelitySettings,
    run_fidelity,
    write_all_trials,
)
from embomatrix.bench.report.figures import BenchError
from embomatrix.sim.fidelity.compare import FidelityTrial, PlanKind, trial_from_json, trial_to_json
from embomatrix.sim.fidelity.sampler import SKILLS
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import parse_plan
from embomatrix.world.dataset import Dataset


def quiet(step):
    """Ignore the progress."""


SMALL = FidelitySettings(plans=20, calls=0, seed=0)
LIMIT_S = 60.0


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("dataset")))


@pytest.fixture(scope="module")
def suite(dataset, tmp_path_factory):
    """A suite against a mode that can't press switches: its folder and its outcome."""
    folder = tmp_path_factory.mktemp("suite")
    return folder, run_fidelity(dataset, SMALL, folder, 2, Modes(load_simulator, clumsy), quiet)


def test_suite_compares_every_plan_and_writes_the_disagreements(suite):
    folder, outcome = suite
    plans = (folder / PLANS_FILE).read_text().splitlines()
    assert len(plans) == len(outcome.comparisons) >= SMALL.plans
    assert not outcome.lost
    differing = [item for item in outcome.comparisons if item.first_difference is not None]
    assert differing
    assert {item.pairs[item.first_difference][0].skill.value for item in differing} == {"toggle_on"}
    disagreements = [json.loads(line) for line in (folder / DISAGREEMENTS_FILE).read_text().splitlines()]
    assert {value["trial"] for value in disagreements} >= {item.trial.trial_id for item in differing}


def test_figures_have_their_documented_names(suite):
    figures = {figure.name: figure for figure in figures_of(suite[1], minutes=None)}
    assert {"final_atoms_equal", "step_outcomes_equal", "plans", "scenes", "skill_speedup_min"} <= set(
        figures
    )
    assert figures["step_outcomes_equal"].value < 1.0
    assert figures["scenes"].value == 1.0


def test_interrupted_suite_resumes(suite, dataset, tmp_path):
    folder, outcome = suite
    for name in (PLANS_FILE, "settings.json"):
        (tmp_path / name).write_text((folder / name).read_text())
    lines = (folder / RESULTS_FILE).read_text().splitlines()
    (tmp_path / RESULTS_FILE).write_text("\n".join(lines[:-2]) + "\n" + lines[-2][:40])
    executed = []
    again = run_fidelity(dataset, SMALL, tmp_path, 1, Modes(load_simulator, clumsy), executed.append)
    assert executed == [
        f"{number} of {len(lines)} plans in both modes" for number in (len(lines) - 1, len(lines))
    ]
    assert [item.cached.atoms for item in again.comparisons] == [
        item.cached.atoms for item in outcome.comparisons
    ]


def test_lost_trial_is_repeated_on_resume(suite, dataset, tmp_path):
    folder, outcome = suite
    for name in (PLANS_FILE, "settings.json"):
        (tmp_path / name).write_text((folder / name).read_text())
    *lines, last = (folder / RESULTS_FILE).read_text().splitlines()
    gone = {**trial_to_json(trial_from_json(json.loads(last))), LOST: "no answer in 180 s"}
    (tmp_path / RESULTS_FILE).write_text("\n".join([*lines, json.dumps(gone)]) + "\n")
    modes = Modes(load_simulator, clumsy)
    assert len(run_fidelity(dataset, SMALL, tmp_path, 0, modes, quiet).lost) == 1
    again = run_fidelity(dataset, SMALL, tmp_path, 1, modes, quiet)
    assert (len(again.comparisons), again.lost) == (len(outcome.comparisons), ())


def test_zero_processes_sum_up_the_results_so_far(suite, dataset, tmp_path):
    folder, _ = suite
    for name in (PLANS_FILE, "settings.json"):
        (tmp_path / name).write_text((folder / name).read_text())
    modes = Modes(load_simulator, clumsy)
    with pytest.raises(BenchError, match="no result to sum up"):
        run_fidelity(dataset, SMALL, tmp_path, 0, modes, quiet)
    lines = (folder / RESULTS_FILE).read_text().splitlines()
    (tmp_path / RESULTS_FILE).write_text("\n".join(lines[:3]) + "\n" + lines[3][:40])
    with (tmp_path / RESULTS_FILE).open("a") as running:  # a suite that is still running
        assert len(run_fidelity(dataset, SMALL, tmp_path, 0, modes, quiet).comparisons) == 3
        running.write(lines[3][40:] + "\n")
    assert (tmp_path / RESULTS_FILE).read_text().splitlines() == lines[:4]


def test_folder_with_other_settings_is_refused(suite, dataset):
    with pytest.raises(BenchError, match="other settings"):
        run_fidelity(dataset, FidelitySettings(21, 0, 0), suite[0], 1, Modes(load_simulator, clumsy), quiet)


def test_plans_reach_the_quota_of_every_skill(dataset):
    settings = FidelitySettings(plans=20, calls=8, seed=1)
    trials = write_all_trials(dataset, settings, Modes(load_simulator, clumsy), quiet)
    calls = [
        call.skill
        for trial in trials
        if trial.kind in (PlanKind.ORACLE, PlanKind.VALID)
        for call in trial.plan
    ]
    assert all(calls.count(skill) >= settings.calls for skill in SKILLS)
    assert trials == write_all_trials(dataset, settings, Modes(load_simulator, clumsy), quiet)


def trials_of(dataset, *texts):
    record = dataset.records[0]
    fridge = record.task.index_of["fridge_1"]
    return tuple(
        FidelityTrial(
            f"t-{number}",
            record.bundle_digest,
            "flat",
            record.task.task_id,
            PlanKind.VALID,
            0,
            parse_plan(text.replace("fridge", str(fridge))),
        )
        for number, text in enumerate(texts)
    )


@pytest.mark.parametrize(
    ("physical", "reason", "limit_s"),
    [
        (dying, "the process died", LIMIT_S),
        (raising, "the door is not a number", LIMIT_S),
        pytest.param(hanging, "no answer in 10 s", 10.0, marks=pytest.mark.slow),
    ],
)
def test_failing_process_costs_only_its_current_trial(dataset, physical, reason, limit_s):
    trials = trials_of(dataset, "move fridge", "move fridge\nopen fridge", "turn 1.0")
    values = []
    pool = FidelityPool(dataset.folder, Modes(load_simulator, physical), 1, limit_s)
    pool.run([trials], values.append)
    assert [value["trial"] for value in values] == ["t-0", "t-1", "t-2"]
    assert [LOST in value for value in values] == [False, True, False]
    assert reason in values[1][LOST]


def test_wrong_dataset_is_one_sentence():
    answer = CliRunner().invoke(app, ["fidelity", "--dataset", "nowhere"])
    assert answer.exit_code == 2
    assert "there is no dataset in nowhere" in answer.output
    assert "Traceback" not in answer.output


def test_damaged_suite_is_refused_with_its_folder(dataset, suite, tmp_path):
    for name in (PLANS_FILE, "settings.json"):
        (tmp_path / name).write_text((suite[0] / name).read_text())
    (tmp_path / RESULTS_FILE).write_text("not JSON\n{}\n")
    with pytest.raises(BenchError, match="damaged"):
        run_fidelity(dataset, SMALL, tmp_path, 1, Modes(load_simulator, clumsy), quiet)
