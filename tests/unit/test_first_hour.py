"""Record of the demo's seeds: its figures, and how a repeated seed is held against it."""

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from embomatrix.bench.first_hour.record import (
    RECORD,
    Arm,
    SeedRun,
    add_to_record,
    comparison,
    figures_of,
    read_record,
)
from embomatrix.bench.first_hour.seeds import FINISHED, FinishedRun, _arm, curve_digest
from embomatrix.bench.report.figures import BenchError

TASKS = [f"task-{number}" for number in range(20)]


def arm(solved: int, wall_s: float = 60.0) -> Arm:
    return Arm({task: float(at < solved) for at, task in enumerate(TASKS)}, 340, 420, wall_s, 2 * wall_s)


def seed(number: int, solved: int, continued: int = 2) -> SeedRun:
    return SeedRun(
        number, "d1", "c1", "x86_64", f"curve-{number}", arm(1).rates, arm(solved, 600.0), arm(continued)
    )


def test_gain_is_paired_by_task_and_the_worst_seed_counts() -> None:
    figures = {figure.name: figure for figure in figures_of([seed(0, 12), seed(1, 7)])}
    assert figures["demo_gain"].value == pytest.approx(((12 - 2) + (7 - 2)) / 2 / 20)
    assert figures["demo_gain_lower_min"].value == seed(1, 7).gain.low
    assert figures["demo_gain_lower_min"].value < 0.25 < seed(0, 12).gain.low
    assert figures["demo_success after GRPO"].value == pytest.approx(100 * (12 + 7) / 40)
    assert figures["demo_minutes"].value == 10.0
    low, high = figures["demo_gain_low"].value, figures["demo_gain_high"].value
    assert low < figures["demo_gain"].value < high


def test_no_seed_has_no_figures() -> None:
    with pytest.raises(BenchError, match="no seed of the demo has run"):
        figures_of([])


def test_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "record.json"
    add_to_record(path, [seed(1, 7), seed(0, 12)])
    assert read_record(path) == (seed(0, 12), seed(1, 7))
    assert read_record(tmp_path / "none.json") == ()
    path.write_text('[{"seed": 0}]')
    with pytest.raises(BenchError, match="is no record of the demo's seeds"):
        read_record(path)


def test_record_keeps_seeds_of_the_same_tasks(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    add_to_record(path, [seed(1, 7), seed(0, 12)])
    assert add_to_record(path, [seed(2, 5), seed(1, 9)]) == [seed(0, 12), seed(1, 9), seed(2, 5)]
    assert add_to_record(path, []) == list(read_record(path)) == [seed(0, 12), seed(1, 9), seed(2, 5)]
    before = path.read_bytes()
    with pytest.raises(BenchError, match=r"of different datasets \(d1, d2\): name another file"):
        add_to_record(path, [replace(seed(2, 5), dataset="d2")])
    assert path.read_bytes() == before


def test_shipped_record_holds_the_first_seeds_on_one_dataset() -> None:
    seeds = read_record(RECORD)
    assert [seed.seed for seed in seeds] == [*range(len(seeds))] != []
    assert len({seed.dataset for seed in seeds}) == 1
    assert all(len(seed.trained.rates) == len(seed.continued.rates) == 200 for seed in seeds)


def test_repeated_seed_is_held_against_the_record() -> None:
    recorded = seed(0, 12)
    assert "is the recorded one" in comparison(recorded, replace(recorded, commit="c2"))
    assert "changed since c1" in comparison(recorded, replace(recorded, curve="other"))
    assert "other tasks" in comparison(recorded, replace(recorded, dataset="d2"))
    assert "platform is another" in comparison(recorded, replace(recorded, curve="other", platform="arm64"))


def test_finished_run_is_kept_if_its_budgets_are_those_asked_for(tmp_path):
    out = tmp_path / "seed-0-grpo"
    out.mkdir()
    ended = FinishedRun({"steps": 5}, "c1", "x86_64", 1.0, 2.0)
    (out / FINISHED).write_bytes(TypeAdapter(FinishedRun).dump_json(ended))
    began = []
    assert _arm(out, 0, {"steps": 5}, began.append) == out
    with pytest.raises(BenchError, match=r"other budgets \(steps 5, now those of the demo\)"):
        _arm(out, 0, {}, began.append)
    (out / FINISHED).write_text("{}")
    with pytest.raises(BenchError, match=r"finished\.json can't be read"):
        _arm(out, 0, {}, began.append)
    assert not began


def test_digest_of_a_curve_is_about_what_the_policy_did():
    row = {"step": 1, "reward": 0.25, "success": 0.5, "gradient_norm": 0.125}
    one, other = {**row, "seconds": 1.0, "spent_s": {"sampling": 1.0}}, {**row, "seconds": 2.0, "kl": None}
    assert curve_digest([one]) == curve_digest([other])
    for name in row:
        assert curve_digest([one]) != curve_digest([{**one, name: 0.75}])
