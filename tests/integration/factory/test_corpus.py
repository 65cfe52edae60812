"""A corpus separates training from held-out tasks and detects changes to the frozen set."""

import dataclasses
import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.pipeline.corpus import (
    FROZEN_FILE,
    HELDOUT_SCENES,
    TRAIN,
    UNSEEN,
    VERIFIED,
    CorpusSettings,
    check_frozen,
    freeze,
    gather_heldout,
)
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import Difficulty


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def _written(folder, kitchen, splits, scene, kinds, words="Request {kind} in {scene}."):
    """Write a dataset of kitchen tasks with the given scene, signatures and words."""
    records = [
        dataclasses.replace(
            record,
            split=split,
            signature=kind,
            task=dataclasses.replace(
                record.task,
                task_id=f"{scene}-{number}",
                scene_id=f"{scene}-x",
                instruction=words.format(kind=kind, scene=scene),
            ),
        )
        for number, (record, split, kind) in enumerate(zip(kitchen.records, splits, kinds, strict=False))
    ]
    write_dataset(
        folder,
        records,
        {record.bundle_digest: kitchen.bundle_bytes(record.bundle_digest) for record in records},
    )


def _freeze(folder, count=10):
    """Freeze the held-out tasks of a corpus as if each were hard."""
    return freeze(folder, gather_heldout(folder).records, count)


@pytest.fixture
def corpus(tmp_path, kitchen):
    """Corpus with two training tasks and one held-out task in one scene, and two tasks in another."""
    _written(tmp_path / TRAIN, kitchen, ("train", "train", "heldout"), "Rs_int", "abc")
    _written(tmp_path / UNSEEN, kitchen, ("heldout", "heldout"), "Ihlen_1_int", "de")
    return tmp_path


def test_held_out_tasks_of_both_builds_are_frozen_together(corpus):
    frozen = _freeze(corpus)
    assert (frozen.tasks, frozen.unseen, frozen.scenes) == (3, 2, ("Ihlen_1_int", "Rs_int"))
    assert {record.split for record in Dataset.load(corpus / VERIFIED).records} == {"heldout"}
    assert check_frozen(corpus) == frozen
    assert _freeze(corpus) == frozen


def test_the_hardest_tasks_are_frozen_most_of_them_in_unseen_scenes(corpus, kitchen):
    _written(corpus / UNSEEN, kitchen, ("heldout",) * 3, "Ihlen_1_int", "dei")
    hard = {"Ihlen_1_int-1", "Ihlen_1_int-2", "Rs_int-2"}
    measured = [
        dataclasses.replace(
            record, difficulty=Difficulty(False, record.task.task_id not in hard, True, 4, None)
        )
        for record in gather_heldout(corpus).records
    ]
    freeze(corpus, measured, 2)
    frozen = [record.task.task_id for record in Dataset.load(corpus / VERIFIED).records]
    assert frozen == ["Rs_int-2", *[name for name in frozen if name in hard and name.startswith("Ihlen")]]
    assert len(frozen) == 2


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


def test_a_goal_of_one_scene_on_both_sides_is_refused(corpus, kitchen):
    _written(corpus / TRAIN, kitchen, ("train", "train", "heldout"), "Rs_int", "aba", "Request {kind} or so.")
    with pytest.raises(DatasetError, match=r"'Request a or so\.' is trained on and held out"):
        _freeze(corpus)
    _written(corpus / UNSEEN, kitchen, ("heldout", "heldout"), "Rs_int", "ae")
    _written(corpus / TRAIN, kitchen, ("train", "train", "train"), "Rs_int", "abc", "Ask for {kind}.")
    with pytest.raises(DatasetError, match="'a' in Rs_int are trained on and held out"):
        _freeze(corpus)


def test_majority_in_training_scenes_is_refused(corpus, kitchen):
    _written(corpus / UNSEEN, kitchen, ("heldout",), "Rs_int", "d")
    with pytest.raises(DatasetError, match="2 of 2 held-out tasks lie in scenes of training"):
        _freeze(corpus)


def test_missing_freeze_is_reported(corpus):
    with pytest.raises(DatasetError, match="does not describe a frozen corpus"):
        check_frozen(corpus)


def test_builds_share_the_seed_but_no_scene_and_most_held_out_tasks_are_unseen():
    builds = CorpusSettings(seed=3).builds()
    train, unseen = builds[TRAIN], builds[UNSEEN]
    assert (train.train, train.heldout, unseen.heldout) == (2_000, 80, 120)
    assert train.seed == unseen.seed == 3
    assert len(train.scenes) == 45
    assert not {*train.scenes} & {*unseen.scenes}
    assert unseen.scenes == HELDOUT_SCENES


def test_corpus_check_prints_the_frozen_digest(corpus):
    _freeze(corpus)
    done = CliRunner().invoke(app, ["corpus", "--out", str(corpus), "--check"])
    assert done.exit_code == 0, done.output
    assert json.loads((corpus / VERIFIED / FROZEN_FILE).read_text())["digest"] in done.output
    (corpus / VERIFIED / FROZEN_FILE).write_text("{}")
    assert CliRunner().invoke(app, ["corpus", "--out", str(corpus), "--check"]).exit_code == 2
