"""A corpus separates training from held-out tasks and detects changes to the frozen set."""

import dataclasses
import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.pipeline.corpus import (
    FROZEN_FILE,
    HELDOUT,
    STARTER,
    TASKS,
    TRAIN,
    VERIFIED,
    CorpusSettings,
    check_frozen,
    freeze,
    join_parts,
    part_folder,
)
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.starter.archive import RECIPE, unpack
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import Difficulty


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def _written(folder, kitchen, splits, scene, kinds, words="Request {kind} in {scene}.", room="kitchen_0"):
    """Write a dataset of kitchen tasks with the given scene, signatures and words."""
    records = [
        dataclasses.replace(
            record,
            split=split,
            signature=kind,
            rooms=(room,),
            task=dataclasses.replace(
                record.task,
                task_id=f"{scene}-{kind}",
                scene_id=f"{scene}-x",
                instruction=words.format(kind=kind, scene=scene),
            ),
        )
        for record, split, kind in zip(kitchen.records, splits, kinds, strict=False)
    ]
    write_dataset(
        folder,
        records,
        {record.bundle_digest: kitchen.bundle_bytes(record.bundle_digest) for record in records},
    )


def _freeze(folder, count=10):
    """Freeze the held-out tasks of a corpus as if each were hard."""
    join_parts(folder, (STARTER, HELDOUT))
    return freeze(folder, Dataset.load(folder / TASKS).records, count)


@pytest.fixture
def corpus(tmp_path, kitchen):
    """Corpus whose first part has two training tasks in a scene and a held-out one in another, its second two held-out ones."""
    _written(part_folder(tmp_path, STARTER), kitchen, ("train", "train"), "Rs_int", "ab")
    _written(part_folder(tmp_path, HELDOUT), kitchen, ("heldout",) * 3, "Ihlen_1_int", "def")
    return tmp_path


def test_parts_become_one_dataset_and_held_out_tasks_are_frozen(corpus):
    frozen = _freeze(corpus)
    assert (frozen.tasks, frozen.scenes) == (3, ("Ihlen_1_int",))
    tasks = Dataset.load(corpus / TASKS)
    assert (len(tasks.train), len(tasks.heldout)) == (2, 3)
    assert {record.split for record in Dataset.load(corpus / VERIFIED).records} == {"heldout"}
    assert check_frozen(corpus) == frozen
    assert _freeze(corpus) == frozen


def test_the_hardest_tasks_are_frozen_and_every_difficulty_is_stored(corpus):
    join_parts(corpus, (STARTER, HELDOUT))
    hard = {"Ihlen_1_int-e", "Ihlen_1_int-f"}
    measured = [
        dataclasses.replace(
            record, difficulty=Difficulty(False, record.task.task_id not in hard, True, 4, None)
        )
        for record in Dataset.load(corpus / TASKS).records
    ]
    freeze(corpus, measured, 2)
    assert {record.task.task_id for record in Dataset.load(corpus / VERIFIED).records} == hard
    assert list(Dataset.load(corpus / TASKS).records) == measured


def test_changed_task_is_detected(corpus):
    _freeze(corpus)
    path = corpus / VERIFIED / "tasks.jsonl"
    path.write_text(path.read_text().replace('"signature":"d"', '"signature":"z"'))
    with pytest.raises(DatasetError, match="differs from the frozen corpus"):
        check_frozen(corpus)


def test_damaged_bundle_is_detected(corpus):
    _freeze(corpus)
    next((corpus / VERIFIED / "bundles").iterdir()).write_bytes(b"other")
    with pytest.raises(DatasetError):
        check_frozen(corpus)


def test_a_training_task_that_gives_a_held_out_one_away_is_left_out(corpus, kitchen):
    _written(part_folder(corpus, STARTER), kitchen, ("train", "train"), "Rs_int", "ad", "Request {kind}.")
    _written(part_folder(corpus, HELDOUT), kitchen, ("heldout",) * 3, "Ihlen_1_int", "def", "Request {kind}.")
    joined = join_parts(corpus, (STARTER, HELDOUT))
    assert joined.dropped == 1
    assert [record.signature for record in Dataset.load(corpus / TASKS).train] == ["a"]


def test_a_scene_on_both_sides_is_refused(corpus, kitchen):
    _written(part_folder(corpus, HELDOUT), kitchen, ("heldout",), "Rs_int", "c", room="pantry_0")
    with pytest.raises(DatasetError, match="tasks in Rs_int are trained on and held out"):
        _freeze(corpus)


def test_missing_freeze_is_reported(corpus):
    with pytest.raises(DatasetError, match="does not describe a frozen corpus"):
        check_frozen(corpus)


def test_builds_add_to_the_shipped_dataset_in_scenes_of_their_own(tmp_path):
    unpack(tmp_path)
    starter = Dataset.load(tmp_path)
    builds = CorpusSettings().builds(starter)
    train, heldout = builds[TRAIN], builds[HELDOUT]
    assert (train.train + len(starter.train), heldout.heldout + len(starter.heldout)) == (2_000, 200)
    assert train.heldout == heldout.train == 0
    used = [{*train.scenes}, {*heldout.scenes}, {base_scene_of(r.task.scene_id) for r in starter.records}]
    assert sum(map(len, used)) == len(set.union(*used)) == len(Catalog.load().scene_ids)
    homes = {base.removesuffix("_int") for base in {base_scene_of(r.task.scene_id) for r in starter.heldout}}
    assert {f"{home}_garden" for home in homes} <= {*heldout.scenes}  # a garden shows much of its home
    with pytest.raises(DatasetError, match=r"found --train 10 --heldout 200, expected more"):
        CorpusSettings(train=10).builds(starter)


def test_a_shipped_dataset_of_another_size_is_not_built_again_for_a_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr("embomatrix.factory.commands.starter.RECIPE", dataclasses.replace(RECIPE, train=1))
    done = CliRunner().invoke(app, ["starter", "--check", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "the recipe makes 1 and 120" in " ".join(done.output.split())
    assert not (tmp_path / "build.jsonl").exists()


def test_corpus_check_prints_the_frozen_digest(corpus):
    _freeze(corpus)
    done = CliRunner().invoke(app, ["corpus", "--out", str(corpus), "--check"])
    assert done.exit_code == 0, done.output
    assert json.loads((corpus / VERIFIED / FROZEN_FILE).read_text())["digest"] in done.output
    (corpus / VERIFIED / FROZEN_FILE).write_text("{}")
    assert CliRunner().invoke(app, ["corpus", "--out", str(corpus), "--check"]).exit_code == 2
