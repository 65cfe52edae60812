"""What the simulated bench hands in: charts that can be read as XML, and a command that finds the bench by entry point."""

import json
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points

import pytest
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.cluster.simulated import bench_simulated_cluster
from embomatrix.bench.cluster.simulated_sweeps import sweeps
from embomatrix.bench.report.line_charts import LineChart, page

SVG = "{http://www.w3.org/2000/svg}"


def texts(svg):
    return [element.text for element in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def test_a_page_has_a_line_for_each_series_and_escapes_its_words():
    lines = {"near & far": {1: 0.0, 10: 0.5, 100: 1.0}, "far": {1: 0.2}}
    svg = page(
        "a <title>", [[LineChart("share", "workers", lines, x_logarithmic=True, percent=True, most=1.0)]]
    )
    root = ElementTree.fromstring(svg)
    assert len(list(root.iter(f"{SVG}polyline"))) == 2
    assert len(list(root.iter(f"{SVG}circle"))) == 4
    assert {"a <title>", "near & far", "share", "workers", "100 %", "10"} <= set(texts(svg))


def test_a_higher_value_stands_higher_and_all_points_stand_inside():
    panel = LineChart("cost", "workers", {"x": {10: 3.0, 100: 30.0, 1000: 300.0}}, True, True)
    root = ElementTree.fromstring(page("costs", [[panel]]))
    points = [(float(dot.get("cx")), float(dot.get("cy"))) for dot in root.iter(f"{SVG}circle")]
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert [y for _, y in points] == sorted((y for _, y in points), reverse=True)
    assert all(0 < x < 270 and 0 < y < 190 for x, y in points)


def test_a_line_of_one_value_or_of_zeros_can_be_drawn():
    page(
        "flat",
        [[LineChart("a", "x", {"x": {5: 0.0}}), LineChart("b", "x", {"x": {5: 1.0}}, x_logarithmic=True)]],
    )


def test_no_sweep_is_larger_than_it_was_allowed():
    for sweep in sweeps(30):
        for points in sweep.points.values():
            assert max(scenario.workers for scenario in points.values()) <= 30


def test_the_bench_is_found_by_its_entry_point():
    (point,) = entry_points(group="embomatrix.benches", name="simulated-cluster")
    assert point.load() is bench_simulated_cluster


@pytest.mark.slow
def test_the_command_draws_the_pictures_and_hands_in_figures(tmp_path):
    out, figures = tmp_path / "pictures", tmp_path / "figures.json"
    arguments = ["cluster", "--simulate", "--most-workers", "10", "--out", str(out), "--json", str(figures)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    found = {figure["name"]: figure["value"] for figure in json.loads(figures.read_text())["figures"]}
    assert found["sim_broken_invariants"] == 0
    assert found["sim_hit_rate, k=2"] >= 0.95
    for name in ("simulated_cluster.svg", "simulated_manager.svg"):
        assert "own network" in texts((out / name).read_text())
    assert "150 µs a rollout" in texts((out / "simulated_saturation.svg").read_text())
    assert found["sim_slots_at_work, 150 µs a rollout, 80 slots"] >= 0.9
