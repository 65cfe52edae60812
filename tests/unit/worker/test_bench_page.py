"""Figures of benches: how they stand to their goals, and the page made of them, which loses nothing that people wrote."""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.report.figures import (
    BenchError,
    BenchResult,
    figure_in,
    is_shared,
    put_together,
    quantile_figure,
    result_to_json,
)
from embomatrix.bench.report.page import END, render_page
from embomatrix.pages.figures import Better, Figure, shown

MACHINE = {"cpu": "a core", "cores": 2, "load_before": 0.1, "gpu": ""}


def test_the_least_speed_up_is_taken_from_the_figures_of_the_two_modes(tmp_path):
    speedup = Figure("skill_speedup_min", 134.0, "×", Better.HIGHER, 5, 100.0)
    path = tmp_path / "fidelity.json"
    path.write_text(json.dumps(result_to_json(BenchResult("fidelity", "abc", MACHINE, (speedup,)))))
    assert figure_in(path, "skill_speedup_min") == speedup
    for text in ("", "[]", '{"figures": []}', '{"figures": [{"name": "skill_speedup_min"}]}'):
        path.write_text(text)
        with pytest.raises(BenchError, match=r"has no figure 'skill_speedup_min'.*bench fidelity --json"):
            figure_in(path, "skill_speedup_min")


@pytest.mark.parametrize(
    ("value", "goal", "better", "verdict"),
    [
        (4.0, 5.0, Better.LOWER, "reached"),
        (9.0, 5.0, Better.LOWER, "1.8 × the goal"),
        (600.0, 500.0, Better.HIGHER, "reached"),
        (250.0, 500.0, Better.HIGHER, "0.5 × the goal"),
        (0.9896, 0.99, Better.HIGHER, "0.9996 × the goal"),
        (1.0, 0.0, Better.LOWER, "missed"),
        (4.0, None, Better.LOWER, ""),
    ],
)
def test_a_figure_says_how_it_stands_to_its_goal(value, goal, better, verdict):
    assert Figure("x", value, "ms", better, 1, goal).verdict == verdict


def test_quantiles_are_told_in_their_unit_and_nothing_measured_is_an_error():
    assert quantile_figure("x", [0.001, 0.002, 0.009], 0.5, "ms") == Figure(
        "x, p50", 2.0, "ms", Better.LOWER, 3
    )
    assert quantile_figure("x", [2e-6], 0.95, "µs").value == pytest.approx(2.0)
    with pytest.raises(BenchError, match="nothing was measured"):
        quantile_figure("x", [], 0.5, "ms")


def test_numbers_are_short_where_people_read_them_and_exact_enough_in_files():
    assert [shown(value) for value in (0.01234, 12.345, 1234.5, 999.7)] == [
        "0.0123",
        "12.3",
        "1,234",
        "1,000",
    ]
    assert Figure("x", 0.98964, "share", Better.HIGHER, 3, 0.99).told == "0.9896"
    assert Figure("x", 0.99036, "share", Better.HIGHER, 3, 0.99).told == "0.99"
    assert Figure("x", 1000.3, "ms", Better.LOWER, 3, 1000.0).told == "1,000.3"
    written = result_to_json(_result(Figure("x", 1.23456789, "ms", Better.LOWER, 3)))
    assert written["figures"] == [
        {"name": "x", "value": 1.23457, "unit": "ms", "goal": None, "better": "lower", "n": 3}
    ]


def test_parts_written_by_hand_survive_a_new_page():
    first = render_page([_result(Figure("x", 1.0, "ms", Better.LOWER, 1))], "")
    marks = "<!-- by hand: training -->\n"
    own = f"<!-- by hand: remarks -->\nWhat we saw.\n{END}\n"
    edited = first.replace(marks, f"{marks}12 % before, 48 % after.\n\n| a | table |\n") + own
    second = render_page([_result(Figure("x", 2.0, "ms", Better.LOWER, 1))], edited)
    assert "12 % before, 48 % after.\n\n| a | table |\n" in second
    assert "What we saw." in second
    assert "| x | 2 ms |" in second
    assert "| x | 1 ms |" not in second
    assert render_page([_result(Figure("x", 2.0, "ms", Better.LOWER, 1))], second) == second


def test_a_page_of_someone_else_is_not_overwritten():
    with pytest.raises(BenchError, match="not written by this command"):
        render_page([_result()], "# My notes\n")


@pytest.mark.parametrize("broken", [END, "<!-- by hand: training -->"])
def test_marks_that_do_not_pair_are_refused_before_text_is_lost(broken):
    page = render_page([_result()], "")
    with pytest.raises(BenchError, match="mend them"):
        render_page([_result()], page.replace(broken, "", 1))


def test_a_busy_machine_and_missed_goals_are_said_on_the_page():
    busy = MACHINE | {"load_before": 3.0}
    assert is_shared(busy)
    assert not is_shared(MACHINE)
    slow = Figure("slow", 9.0, "ms", Better.LOWER, 1, 3.0)
    page = render_page([BenchResult("rollout", "abc", busy, (slow,))], "")
    assert "The machine was shared: a load of 3.0 on 2 cores" in page
    assert "| slow | 9 ms | ≤ 3 | 3 × the goal | 1 |" in page
    assert "Short of their goals: slow." in page
    assert "shared" not in render_page([_result(replace(slow, value=2.0))], "")


def _result(*figures):
    return BenchResult("rollout", "abc", MACHINE, figures)


def test_the_page_is_made_of_figures_that_were_measured_before(tmp_path):
    speedup = Figure("skill_speedup_min", 250.0, "×", Better.HIGHER, 7, 100.0)
    steps = Figure("step_outcomes_equal", 0.99, "share", Better.HIGHER, 5000, 0.98)
    results = [
        BenchResult("engine", "abc", MACHINE, (Figure("reset_ms", 0.05, "ms", Better.LOWER, 10, 0.1),)),
        BenchResult("fidelity", "def", MACHINE, (steps, speedup)),
    ]
    files = [tmp_path / f"{result.bench}.json" for result in results]
    for file, result in zip(files, results, strict=True):
        file.write_text(json.dumps(result_to_json(result)))
    out = tmp_path / "page.md"
    answer = CliRunner().invoke(app, ["page", *map(str, files), "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    engine, fidelity = out.read_text().split("## Fidelity of the two modes")
    assert "| skill_speedup_min | 250 × | ≥ 100 | reached | 7 |" in engine
    assert "| step_outcomes_equal | 0.99 share | ≥ 0.98 | reached | 5,000 |" in fidelity
    assert "commit `def`" in fidelity


@pytest.mark.parametrize("bench", ["engine", "fidelity", "rollout", "cluster", "trainer", "operations"])
def test_every_bench_has_its_place_on_the_page_with_what_was_measured_and_how(bench):
    page = render_page([replace(_result(Figure("it_s", 2.0, "s", Better.LOWER, 1, 3.0)), bench=bench)], "")
    assert f"`embomatrix bench {bench}" in page
    assert "| it_s | 2 s | ≤ 3 | reached | 1 |" in page


def test_parts_of_a_bench_make_one_result_when_they_are_of_one_commit():
    old, new, other = (
        Figure(name, value, "ms", Better.LOWER, 1) for name, value in (("x", 1.0), ("x", 2.0), ("y", 3.0))
    )
    busy = replace(_result(new, other), machine=MACHINE | {"load_before": 3.0})
    [whole] = put_together([_result(old), busy])
    assert whole.figures == (new, other)
    assert is_shared(whole.machine)
    with pytest.raises(BenchError, match="commits abc and def"):
        put_together([_result(old), replace(busy, commit="def")])


def test_a_file_that_holds_no_figures_is_named(tmp_path):
    damaged = tmp_path / "engine.json"
    for text in ("", "[]", '{"bench": "engine", "commit": "a", "machine": {}, "figures": []}'):
        damaged.write_text(text)
        answer = CliRunner().invoke(app, ["page", str(damaged), "--out", str(tmp_path / "page.md")])
        assert answer.exit_code == 2
        assert "holds no figures of a bench" in " ".join(answer.output.split())
    assert not (tmp_path / "page.md").exists()
