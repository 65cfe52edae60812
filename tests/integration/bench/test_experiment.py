"""`embomatrix experiment`: refusals, resumption, and reports of finished runs."""

import json
import math
from dataclasses import replace
from datetime import date

import pytest
from typer.testing import CliRunner

from embomatrix.bench.experiments import cli
from embomatrix.bench.experiments.benchmarks import PolicyStage, bench_table, benchmark_section
from embomatrix.bench.experiments.cli import app
from embomatrix.bench.experiments.conduct import IMITATED, Conductor, Venue
from embomatrix.bench.experiments.design import (
    RELEVANCE_ARMS,
    Arm,
    Budget,
    Design,
    checked_arms,
    keep_design,
    parse_arm,
    parse_settings,
    toml_of,
)
from embomatrix.bench.experiments.findings import Run, curve, difference, figures_of, findings_of
from embomatrix.bench.experiments.section import add_section, learning_section
from embomatrix.cli.local_cluster import no_problem
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.logging.outcome import RunOutcome, TaskRate, read_outcome, write_outcome

DESIGN = Design(
    name="learning",
    dataset="`ds` (abc)",
    model="tiny",
    seeds=(0, 1),
    imitation=Budget(60.0),
    patience=3,
    grpo=Budget(120.0, 50),
    threads=2,
    shared={},
    arms=RELEVANCE_ARMS,
)
TODAY = date(2026, 11, 21)
MACHINE = {"cores": 2, "cpu": "a processor", "load_before": 0.1}


def outcome(before, after):
    """Return an outcome of two tasks with these success rates."""
    spent = {"sampling": 40.0, "update": 50.0, "waiting for simulation": 4.0, "imitation": 60.0}
    tasks = [
        [TaskRate(f"t{at}", "compound", rate) for at, rate in enumerate(rates)] for rates in (before, after)
    ]
    return RunOutcome("tiny", 100, 20, 320, 0, 200.0, 100.0, spent, tuple(tasks[0]), tuple(tasks[1]))


def run(seed, arm, before, after):
    metrics = [
        {"success": step / 20, "zero_variance_groups": 0.5, "entropy": 0.2, "plan_steps": 4.0}
        for step in range(20)
    ]
    return Run(seed, arm, outcome(before, after), metrics)


ARMS = (
    findings_of(
        "with-relevance",
        [run(0, "with-relevance", (0.2, 0.4), (0.5, 0.7)), run(1, "with-relevance", (0.4, 0.4), (0.5, 0.9))],
    ),
    findings_of("without-relevance", [run(0, "without-relevance", (0.2, 0.4), (0.1, 0.1))]),
)


def invoke(*arguments):
    """Return the exit status and all visible output."""
    result = CliRunner().invoke(app, [str(item) for item in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, " ".join(result.output.split())


@pytest.fixture
def dataset(tmp_path):
    folder = tmp_path / "ds"
    folder.mkdir()
    (folder / "tasks.jsonl").write_text("{}\n")
    return folder


def test_task_counts_once_with_its_mean_over_the_seeds():
    assert ARMS[0].before.value == pytest.approx(0.35)
    assert ARMS[0].after.value == pytest.approx(0.65)
    assert ARMS[0].gain.value == pytest.approx(0.3)


def test_task_without_results_changes_no_figure():
    found = findings_of("a", [run(0, "a", (0.2, None), (0.4, 1.0))])
    assert (found.before.value, found.gain.value) == (pytest.approx(0.2), pytest.approx(0.2))


def test_figures_have_the_names_of_the_ablation():
    figures = {figure.name: figure for figure in figures_of(ARMS)}
    assert figures["success_after"].value == pytest.approx(0.65)
    assert figures["success_after_no_relevance"].value == pytest.approx(0.1)
    assert figures["sim_wait_share"].value == pytest.approx(0.04)
    assert figures["overhead_ratio"].value == pytest.approx(0.1)
    assert not figures["success_after"].is_reached
    assert figures["success_gain"].is_reached


def test_other_arms_are_compared_with_the_first_by_seed_and_task():
    first = findings_of(
        "plain", [run(0, "plain", (0.0, 0.0, 0.0), (0.2, 0.4, 0.6)), run(1, "plain", (0.0,), (0.5,))]
    )
    other = findings_of("fast", [run(0, "fast", (0.0, 0.0, 0.0), (0.3, 0.4, 0.8))])
    change = difference(first, other)
    assert change.value == pytest.approx(0.1)
    assert change.low < 0.1 < change.high
    figures = {figure.name: figure.value for figure in figures_of([first, other])}
    names = ("success_difference_fast", "success_difference_fast_low", "success_difference_fast_high")
    assert [figures[name] for name in names] == [change.value, change.low, change.high]


def test_gain_of_equal_tasks_is_not_certain():
    figures = {
        figure.name: figure
        for figure in figures_of([findings_of("a", [run(0, "a", (0.0, 0.0), (0.0, 0.0))])])
    }
    assert figures["success_gain_low"].value < 0
    assert not figures["success_gain_low"].is_reached


def test_curve_has_ten_parts_or_one_per_step():
    long = run(0, "a", (0.0,), (0.0,))
    assert curve(long, "success") == pytest.approx([(2 * at + 0.5) / 20 for at in range(10)])
    assert len(curve(replace(long, metrics=long.metrics[:3]), "success")) == 3
    assert curve(replace(long, metrics=[]), "success") == ()


def test_steps_without_a_metric_are_left_out_of_the_curve():
    recorded = run(0, "a", (0.0,), (0.0,))
    metrics = [
        dict(row, entropy=None if step in (1, 18, 19) else 0.3) for step, row in enumerate(recorded.metrics)
    ]
    values = curve(replace(recorded, metrics=metrics), "entropy")
    assert values[:9] == pytest.approx([0.3] * 9)
    assert math.isnan(values[9])


def test_section_has_configuration_success_curves_and_times():
    text = learning_section(DESIGN, ARMS, MACHINE, "abc", TODAY)
    assert text.startswith("## 2026-11-21: learning")
    assert "at most 60 s of imitation" in text
    assert "50 steps of GRPO per" in text
    assert "| without-relevance | `grpo.relevance = 0.0` |" in text
    assert "| with-relevance | all |  |  |  | 35.0%" in text
    assert "| with-relevance | 1 | zero-variance groups | 0.50 |" in text
    assert "| with-relevance | 0 | 5.00 | 40.0% | 50.0% | 4.0% | 10.0% | – |" in text
    widths = {line.count("|") for line in text.splitlines() if line.startswith("| with-relevance | 0 | s")}
    assert widths == {14}


def test_section_shows_memory_only_for_runs_that_recorded_it():
    recorded = run(0, "a", (), ())
    found = findings_of("a", [replace(recorded, outcome=replace(recorded.outcome, peak_mb=2345.6))])
    assert "| 10.0% | 2,346 MB |" in learning_section(DESIGN, [found], MACHINE, "abc", TODAY)


def test_section_without_held_out_tasks_has_no_success():
    found = findings_of("a", [run(0, "a", (), ())])
    assert [figure.name for figure in figures_of([found])] == ["sim_wait_share", "overhead_ratio"]
    text = learning_section(DESIGN, [found], MACHINE, "abc", TODAY)
    assert "| a | 0 | 20 | 320 | 0 | – | – | – |" in text


def test_sections_are_appended_and_never_removed(tmp_path):
    page = tmp_path / "docs" / "experiments.md"
    add_section(page, "## one\n")
    page.write_text(page.read_text() + "\nBy hand: it failed.\n")
    add_section(page, "## two\n")
    text = page.read_text()
    assert text.startswith("# Experiments")
    assert text.index("## one") < text.index("By hand: it failed.") < text.index("## two")


def test_arm_settings_are_parsed_like_the_trainers_file(tmp_path):
    arm = parse_arm("fast:grpo.learning_rate=4e-4, grpo.loss=grpo,grpo.relevance_final=0.5")
    path = tmp_path / "settings.toml"
    path.write_text(toml_of(arm.settings))
    settings = read_settings(path, {})
    assert (settings.grpo.learning_rate, settings.grpo.loss.value) == (4e-4, "grpo")
    assert parse_arm("plain") == Arm("plain", {})


@pytest.mark.parametrize("text", ["grpo.group", "=3", "grpo.group="])
def test_setting_without_key_or_value_is_refused(text):
    with pytest.raises(TrainerError, match="expected KEY=VALUE"):
        parse_settings([text])


def test_arms_of_one_name_are_refused():
    with pytest.raises(TrainerError, match="one name for each"):
        checked_arms([Arm("a", {}), Arm("a", {"grpo.group": "4"})])


def test_experiment_resumes_only_with_the_same_design(tmp_path):
    keep_design(tmp_path, DESIGN)
    keep_design(tmp_path, DESIGN)
    with pytest.raises(TrainerError, match="another experiment: grpo differ"):
        keep_design(tmp_path, replace(DESIGN, grpo=Budget(120.0)))


def test_finished_runs_are_not_repeated(tmp_path):
    """Without a dataset, a repeated run would end in SystemExit."""
    conductor = Conductor(DESIGN, tmp_path / "nowhere", tmp_path, lambda heading: None)
    venue = Venue(("--manager=127.0.0.1:1",), no_problem)
    (conductor.folder_of(0, IMITATED) / "reference").mkdir(parents=True)
    conductor.folder_of(0, "with-relevance").mkdir()
    write_outcome(conductor.folder_of(0, "with-relevance"), outcome((0.2,), (0.5,)))
    conductor.imitate(0)
    conductor.train(0, RELEVANCE_ARMS[0], venue)


def test_so_far_reports_finished_runs_only(dataset, tmp_path):
    out, page = tmp_path / "out", tmp_path / "page.md"
    options = ("--seed=0", "--seed=1", "--so-far", f"--dataset={dataset}", f"--out={out}", f"--page={page}")
    status, text = invoke("learning", *options)
    assert (status, "no run in" in text) == (2, True)
    done = out / "seed-1" / "with-relevance"
    done.mkdir(parents=True)
    write_outcome(done, outcome((0.2, 0.2), (0.5, 0.9)))
    status, text = invoke("learning", *options, f"--json={tmp_path / 'figures.json'}")
    assert status == 0, text
    assert "| with-relevance | 1 | 20 | 320 | 0 | 20.0% | 70.0% |" in page.read_text()
    figures = {
        each["name"]: each["value"] for each in json.loads((tmp_path / "figures.json").read_text())["figures"]
    }
    assert figures["success_after"] == 0.7
    assert "success_after_no_relevance" not in figures


def test_outcome_survives_a_round_trip(tmp_path):
    found = outcome((0.2, None), (0.5, 1.0))
    write_outcome(tmp_path, found)
    assert read_outcome(tmp_path) == found
    for damaged in ('{"schema": 1}', "[[]]", "3", "[" * 5_000):
        (tmp_path / "outcome.json").write_text(damaged)
        with pytest.raises(TrainerError, match="not the outcome of a finished run"):
            read_outcome(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("learning", "--dataset=nowhere"), "no dataset at nowhere: get the shipped one"),
        (("compare", "--arm=Fast:a=1", "--dataset=DS"), "has the name 'Fast': expected small letters"),
        (("compare", "--arm=a:grpo.speed=1", "--dataset=DS"), "unknown setting 'grpo.speed'"),
        (("learning", "--set=grpo.group=1", "--dataset=DS"), "setting 'grpo.group'"),
        (("table", "--run=nowhere", "--bench=DS"), "not the outcome of a finished run"),
    ],
)
def test_impossible_experiment_is_refused_at_once(dataset, tmp_path, arguments, words):
    filled = [item.replace("DS", str(dataset)) for item in arguments]
    out = () if arguments[0] == "table" else (f"--out={tmp_path / 'out'}",)
    status, text = invoke(*filled, *out)
    assert status == 2
    assert words in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("bench", "figure"),
    [
        ("build/internal-verified", "internal_verified_success"),
        ("eai", "eai_world_success"),
        ("eai-native", "eai_native_success"),
    ],
)
def test_benchmark_has_a_line_for_each_stage(tmp_path, bench, figure):
    stages = (PolicyStage("imitation", tmp_path / "a"), PolicyStage("GRPO", tmp_path / "b"))
    for stage, value in zip(stages, (0.25, 0.5), strict=True):
        estimate = {"value": value, "low": 0.1, "high": 0.8}
        overall = {"success": estimate, "partial": estimate, "tasks": 4}
        path = stage.report(tmp_path, bench)
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"overall": overall, "categories": {}, "samples": 40}))
    lines, figures = bench_table(tmp_path, bench, stages)
    assert [(each.name, each.value) for each in figures] == [(f"{figure}_before", 0.25), (figure, 0.5)]
    text = benchmark_section(tmp_path, lines, "abc", TODAY)
    assert "| GRPO | 50.0 [10.0, 80.0] |" in text


def test_load_of_a_table_is_read_before_its_evaluations(tmp_path, monkeypatch):
    write_outcome(tmp_path, outcome((0.0, 0.5), (0.5, 1.0)))
    for folder in ("reference", "checkpoints/step-000020"):
        (tmp_path / folder).mkdir(parents=True)
    load = [0.25]
    monkeypatch.setattr(cli, "describe_machine", lambda: MACHINE | {"load_before": load[0]})
    monkeypatch.setattr(cli, "bench_table", lambda *_: ((), ()))
    monkeypatch.setattr(cli, "run_command", lambda *_: load.insert(0, 8.0))
    status, text = invoke("table", f"--run={tmp_path}", "--bench=eai")
    assert status == 0, text
    assert load[0] == 8.0
    assert "load before 0.25" in text
    assert "The machine was busy" not in text
