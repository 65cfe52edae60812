"""`embomatrix experiment` from imitation to the page, on a dedicated cluster; finished runs are not repeated."""

import json

import pytest
from tests.fakes.commands import run

pytestmark = pytest.mark.slow
SMALL = (
    "--set=tiny.layers=1",
    "--set=tiny.width=32",
    "--set=tiny.inner=32",
    "--set=grpo.tasks_per_step=1",
    "--set=grpo.group=2",
    "--set=grpo.max_new=12",
)


def test_experiment_runs_to_its_page_and_resumes(kitchen, tmp_path):
    page, figures = tmp_path / "page.md", tmp_path / "figures.json"
    command = (
        *("experiment", "compare", f"--dataset={kitchen}", f"--out={tmp_path / 'out'}", *SMALL),
        *("--arm=plain", "--arm=slow:grpo.learning_rate=1e-6", "--seed=3", "--workers=1", "--threads=1"),
        *("--imitate-steps=3", "--steps=2", "--patience=0", f"--page={page}", f"--json={figures}"),
    )
    first = run(*command)
    assert first.status == 0, first.text
    assert "seed 3: imitation" in first.text
    runs = tmp_path / "out" / "seed-3"
    assert {path.name for path in runs.iterdir()} == {"imitated", "plain", "slow"}
    assert json.loads((runs / "slow" / "outcome.json").read_text())["steps"] == 2
    names = {figure["name"] for figure in json.loads(figures.read_text())["figures"]}
    assert {"sim_wait_share", "overhead_ratio"} <= names
    (runs / "slow" / "outcome.json").unlink()  # as if it had been killed just before its end
    again = run(*command)
    assert again.status == 0, again.text
    assert "seed 3: plain" not in again.text
    assert "seed 3: slow" in again.text
    assert page.read_text().count("## ") == 2
