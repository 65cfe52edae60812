"""Figures of benchmarks and the page of their tables, which keeps all other text."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.report.figures import (
    BenchError,
    BenchResult,
    is_shared,
    merge_parts,
    quantile_figure,
    result_to_json,
)
from embomatrix.bench.report.page import END, ablation_lines, check_page, render_page
from embomatrix.pages.figures import Better, Figure, shown

MACHINE = {"cpu": "a core", "cores": 2, "load_before": 0.1, "gpu": ""}


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
def test_verdict_compares_a_figure_with_its_goal(value, goal, better, verdict):
    assert Figure("x", value, "ms", better, 1, goal).verdict == verdict


def test_quantile_has_its_unit_and_needs_a_measurement():
    assert quantile_figure("x", [0.001, 0.002, 0.009], 0.5, "ms") == Figure(
        "x, p50", 2.0, "ms", Better.LOWER, 3
    )
    assert quantile_figure("x", [2e-6], 0.95, "µs").value == pytest.approx(2.0)
    with pytest.raises(BenchError, match="nothing was measured"):
        quantile_figure("x", [], 0.5, "ms")


def test_numbers_are_short_in_tables_and_have_six_digits_in_files():
    assert [shown(value) for value in (0.01234, 12.345, 1234.5, 999.7)] == [
        "0.0123",
        "12.3",
        "1,234",
        "1,000",
    ]
    assert Figure("x", 0.98964, "share", Better.HIGHER, 3, 0.99).formatted == "0.9896"
    assert Figure("x", 0.99036, "share", Better.HIGHER, 3, 0.99).formatted == "0.99"
    assert Figure("x", 1000.3, "ms", Better.LOWER, 3, 1000.0).formatted == "1,000.3"
    written = result_to_json(_result(Figure("x", 1.23456789, "ms", Better.LOWER, 3)))
    assert written["figures"] == [
        {"name": "x", "value": 1.23457, "unit": "ms", "goal": None, "better": "lower", "n": 3}
    ]


def test_text_between_the_tables_survives_a_new_page():
    first = render_page([_result(Figure("x", 1.0, "ms", Better.LOWER, 1))], "")
    edited = (
        first.replace("# Benchmarks\n", "# Benchmarks\n\n12 % before, 48 % after.\n") + "\nOur remarks.\n"
    )
    second = render_page([_result(Figure("x", 2.0, "ms", Better.LOWER, 1))], edited)
    assert "12 % before, 48 % after.\n" in second
    assert second.endswith("\nOur remarks.\n")
    assert "| x | 2 ms |" in second
    assert "| x | 1 ms |" not in second
    assert render_page([_result(Figure("x", 2.0, "ms", Better.LOWER, 1))], second) == second


def test_page_without_marks_is_not_overwritten():
    with pytest.raises(BenchError, match="has no marks"):
        render_page([_result()], "# My notes\n")


@pytest.mark.parametrize("broken", [END, "<!-- figures: engine -->"])
def test_marks_that_do_not_pair_are_refused_before_text_is_lost(broken):
    page = render_page([_result()], "")
    with pytest.raises(BenchError, match="do not pair"):
        render_page([_result()], page.replace(broken, "", 1))


def test_busy_machine_and_missed_goals_are_stated_on_the_page():
    busy = MACHINE | {"load_before": 3.0}
    assert is_shared(busy)
    assert not is_shared(MACHINE)
    slow = Figure("slow", 9.0, "ms", Better.LOWER, 1, 3.0)
    page = render_page([BenchResult("engine", "abc", busy, (slow,))], "")
    assert "2 cores, load 3.0 before. The machine was shared" in page
    assert "| slow | 9 ms | ≤ 3 | 3 × the goal | 1 |" in page
    assert "Goals missed: slow." in page
    assert "shared" not in render_page([_result(replace(slow, value=2.0))], "")


def test_ablation_is_shown_beside_the_paper():
    measured = {"naive": 3000.0, "cached": 30.0, "scheduler": 5.0, "dispatcher": 2.0}
    figures = [Figure(f"ablation_{row}_ms", value, "ms", Better.LOWER, 9) for row, value in measured.items()]
    lines = ablation_lines(figures)
    assert "| naive | 3.48 | 1 × | 3,000 | 1 × |" in lines[2]
    assert "| + Task-Dispatcher | 0.07 | 49.7 × | 2 | 1,500 × |" in lines[5]
    page = render_page([replace(_result(*figures), bench="cluster")], "")
    assert page.index("<!-- figures: ablation -->") < page.index("<!-- figures: cluster -->")
    assert ablation_lines(()) == []


def test_committed_page_has_a_table_of_every_benchmark():
    page = Path(__file__).parents[3] / "docs" / "benchmarks.md"
    text = page.read_text(encoding="utf-8")
    check_page(text)
    for name in ("engine", "cluster", "ablation", "peers", "trainer", "fidelity"):
        assert f"<!-- figures: {name} -->" in text


def _result(*figures):
    return BenchResult("engine", "abc", MACHINE, figures)


def test_page_command_renders_figures_that_were_measured_before(tmp_path):
    speedup = Figure("skill_speedup_min", 250.0, "×", Better.HIGHER, 7, 100.0)
    results = [
        BenchResult("engine", "abc", MACHINE, (Figure("reset_ms", 0.05, "ms", Better.LOWER, 10, 0.1),)),
        BenchResult("fidelity", "def", MACHINE, (speedup,)),
    ]
    files = [tmp_path / f"{result.bench}.json" for result in results]
    for file, result in zip(files, results, strict=True):
        file.write_text(json.dumps(result_to_json(result)))
    out = tmp_path / "page.md"
    answer = CliRunner().invoke(app, ["page", *map(str, files), "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    engine, fidelity = out.read_text().split("## Fidelity")
    assert "| reset_ms | 0.05 ms | ≤ 0.1 | reached | 10 |" in engine
    assert "| skill_speedup_min | 250 × | ≥ 100 | reached | 7 |" in fidelity
    assert "Commit `def`" in fidelity


def test_parts_of_a_benchmark_merge_if_their_commits_match():
    old, new, other = (
        Figure(name, value, "ms", Better.LOWER, 1) for name, value in (("x", 1.0), ("x", 2.0), ("y", 3.0))
    )
    busy = replace(_result(new, other), machine=MACHINE | {"load_before": 3.0})
    [whole] = merge_parts([_result(old), busy])
    assert whole.figures == (new, other)
    assert is_shared(whole.machine)
    with pytest.raises(BenchError, match="commits abc and def"):
        merge_parts([_result(old), replace(busy, commit="def")])


def test_file_without_figures_is_named(tmp_path):
    damaged = tmp_path / "engine.json"
    for text in ("", "[]", '{"bench": "engine", "commit": "a", "machine": {}, "figures": []}'):
        damaged.write_text(text)
        answer = CliRunner().invoke(app, ["page", str(damaged), "--out", str(tmp_path / "page.md")])
        assert answer.exit_code == 2
        assert "holds no figures of a benchmark" in " ".join(answer.output.split())
    assert not (tmp_path / "page.md").exists()
