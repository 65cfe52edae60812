"""Benchmark of pictures: figures of one scene, and its command."""

from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.pictures.renders import FAST_GOAL_MS, FINE_GOAL_S, bench_renders


def test_fast_pictures_take_less_time_than_fine_ones() -> None:
    steps: list[str] = []
    figures = {figure.name: figure for figure in bench_renders(steps.append, ["gates_bedroom"])}
    assert steps == ["gates_bedroom"]
    assert figures["render_fast_ms"].goal == FAST_GOAL_MS
    assert figures["render_fine_s"].goal == FINE_GOAL_S
    assert 0 < figures["render_fast_ms"].value < 1000 * figures["render_fine_s"].value
    assert figures["render_fine_s"].value <= figures["render_fine_s, longest"].value


def test_command_says_what_it_measures() -> None:
    result = CliRunner().invoke(app, ["pictures", "--help"])
    assert result.exit_code == 0
    assert "pictures of base scenes" in result.output
