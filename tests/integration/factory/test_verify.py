"""Second verification of admitted tasks: differences, refusals and failures in physics are reported."""

import dataclasses
import json
from typing import TYPE_CHECKING

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.admission import PlanFailure
from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.verification import Judgement, compared, evaluation_of, objections, sampled
from embomatrix.world.dataset import Dataset, write_dataset

if TYPE_CHECKING:
    from pathlib import Path

SLIPPED = PlanFailure("grasp_slipped", "step 2, pick_up: it fell")
FINE = Judgement("fetch", "", "sha256:1", agrees=True)


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def test_equal_judgements_agree_with_the_dataset() -> None:
    assert compared(FINE, FINE).agrees
    assert not compared(FINE, dataclasses.replace(FINE, digest="sha256:2")).agrees
    assert not compared(FINE, dataclasses.replace(FINE, agrees=False)).agrees
    refused = dataclasses.replace(FINE, cached="no_plan: none", digest="")
    assert compared(FINE, refused).cached == "no_plan: none"


def test_shares_count_tested_modes_and_objections_name_the_task() -> None:
    verdicts = [
        compared(FINE, dataclasses.replace(FINE, in_physics=True)),
        compared(FINE, dataclasses.replace(FINE, in_physics=True, physical=SLIPPED)),
    ]
    evaluation = evaluation_of(verdicts, {})
    assert evaluation.figure("oracle_cached").value == 100
    assert (evaluation.figure("oracle_physical").value, evaluation.figure("oracle_physical").n) == (50, 2)
    assert evaluation.notes == ("Plans that failed in physics: grasp_slipped 1.",)
    assert list(objections(verdicts)) == ["fetch, in physics: grasp_slipped: step 2, pick_up: it fell"]
    without = evaluation_of([compared(FINE, FINE)], {})
    assert [figure.name for figure in without.figures] == ["oracle_cached", "reverified_bit_equal"]


def test_sample_depends_on_the_seed_and_keeps_the_order(kitchen: Dataset) -> None:
    chosen = sampled(kitchen.records, 2, 3)
    assert chosen == sampled(kitchen.records, 2, 3)
    places = [kitchen.records.index(record) for record in chosen]
    assert places == sorted(set(places))
    assert sampled(kitchen.records, None, 0) == list(kitchen.records)


def test_command_judges_tasks_in_other_processes_and_in_physics(tmp_path: "Path", kitchen: Dataset) -> None:
    """The first task is unchanged; the other has a plan that the oracle does not find."""
    first, other = kitchen.records[0], kitchen.records[1]
    other = dataclasses.replace(other, oracle=first.oracle)
    folder = tmp_path / "tasks"
    bundles = {record.bundle_digest: kitchen.bundle_bytes(record.bundle_digest) for record in (first, other)}
    write_dataset(folder, [first, other], bundles)
    file = tmp_path / "verified.json"
    result = CliRunner().invoke(
        app, ["verify", "--dataset", str(folder), "--physical", "--jobs", "1", "--json", str(file)]
    )
    assert result.exit_code == 1
    assert f"{other.task.task_id}: two processes, or one of them and the dataset, differ" in result.output
    figures = {each["name"]: each["value"] for each in json.loads(file.read_text())["figures"]}
    assert figures == {"oracle_cached": 100, "reverified_bit_equal": 50, "oracle_physical": 50}


def test_dataset_without_tasks_is_reported(tmp_path: "Path") -> None:
    write_dataset(tmp_path, [], {})
    result = CliRunner().invoke(app, ["verify", "--dataset", str(tmp_path)])
    assert result.exit_code == 2
    assert "contains no task" in result.output
