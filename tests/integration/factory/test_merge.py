"""A merge keeps held-out tasks unseen, drops duplicates, overwrites nothing and copies bundles by digest."""

import dataclasses
import json
import re

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.pipeline.export import dataset_card
from embomatrix.factory.pipeline.merge import ConflictKind, Resolution, merge_datasets
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import Difficulty


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def write(folder, kitchen, **changes):
    """Write the kitchen's tasks in another flat with new ids, signatures and words. ``changes`` apply to every record."""
    records = [
        dataclasses.replace(
            record,
            signature=f"{record.signature} {folder.name}",
            task=dataclasses.replace(
                record.task,
                task_id=f"{folder.name}-{number}",
                scene_id=f"{folder.name}-x",
                instruction=f"{record.task.instruction} In {folder.name}.",
            ),
        )
        for number, record in enumerate(kitchen.records)
    ]
    records = [dataclasses.replace(record, **changes) for record in records]
    write_dataset(folder, records, {d: kitchen.bundle_bytes(d) for d in {r.bundle_digest for r in records}})
    return folder


def test_tasks_of_separate_scenes_are_merged_in_order(kitchen, tmp_path):
    folders = [write(tmp_path / name, kitchen) for name in ("a", "b")]
    done = merge_datasets(folders, tmp_path / "out")
    merged = Dataset.load(tmp_path / "out")
    assert merged.records == tuple(record for folder in folders for record in Dataset.load(folder).records)
    assert (done.records, done.duplicates, done.conflicts) == (merged.records, 0, ())
    for record in merged.records:
        assert merged.bundle_bytes(record.bundle_digest) == kitchen.bundle_bytes(record.bundle_digest)
    card = dataset_card(merged, "tasks.jsonl", b"")
    assert "`embomatrix factory merge` of `a`, 4 tasks, `sha256:" in card


def test_exact_duplicates_are_dropped(kitchen, tmp_path):
    first, again = (write(tmp_path / name / "a", kitchen) for name in ("x", "y"))
    done = merge_datasets([first, again], tmp_path / "out")
    assert (len(done.records), done.duplicates) == (4, 4)


def test_measured_difficulty_of_one_of_two_copies_is_kept(kitchen, tmp_path):
    measured = Difficulty(True, True, True, 4, None)
    plain = write(tmp_path / "x" / "a", kitchen)
    other = write(tmp_path / "y" / "a", kitchen, difficulty=measured)
    for number, folders in enumerate(([plain, other], [other, plain])):
        done = merge_datasets(folders, tmp_path / f"out-{number}")
        assert (len(done.records), done.duplicates) == (4, 4)
        assert {record.difficulty for record in done.records} == {measured}


def test_one_id_for_two_tasks_is_refused(kitchen, tmp_path):
    first = write(tmp_path / "x" / "a", kitchen)
    other = write(tmp_path / "y" / "a", kitchen, signature="open(door)")
    with pytest.raises(
        DatasetError, match=r"two tasks have the id 'a-0' and differ in signature.*another seed"
    ):
        merge_datasets([first, other], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (ConflictKind.TASK, lambda train, held: held),
        (
            ConflictKind.SIGNATURE,
            lambda train, held: dataclasses.replace(
                train,
                signature=held.signature,
                rooms=(),
                task=dataclasses.replace(train.task, scene_id=held.task.scene_id),
            ),
        ),
        (
            ConflictKind.INSTRUCTION,
            lambda train, held: dataclasses.replace(
                train,
                task=dataclasses.replace(train.task, instruction=held.task.instruction.upper()),
            ),
        ),
        (
            ConflictKind.ROOM,
            lambda train, held: dataclasses.replace(
                train, task=dataclasses.replace(train.task, scene_id=held.task.scene_id)
            ),
        ),
    ],
)
def test_training_task_that_shares_something_with_a_held_out_one_is_refused_or_left_out(
    kitchen, tmp_path, kind, change
):
    first = write(tmp_path / "a", kitchen)
    held = next(record for record in Dataset.load(first).records if record.split == "heldout")
    records = [*Dataset.load(write(tmp_path / "b", kitchen, split="train")).records]
    records[0] = dataclasses.replace(change(records[0], held), split="train")
    second = tmp_path / "b"
    write_dataset(second, records, {})
    with pytest.raises(DatasetError, match=re.escape(f"1 by {kind}") + ".*--resolve drop-train"):
        merge_datasets([first, second], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    done = merge_datasets([first, second], tmp_path / "out", Resolution.DROP_TRAIN)
    assert (done.dropped, len(done.records)) == (1, 7)
    assert held in done.records
    other = merge_datasets([first, second], tmp_path / "other", Resolution.DROP_HELDOUT)
    assert held not in other.records


def test_splits_of_one_dataset_are_its_own_matter(kitchen, tmp_path):
    """The rooms of the kitchen's held-out task are those of its training tasks."""
    first, second = (write(tmp_path / name, kitchen) for name in ("a", "b"))
    assert merge_datasets([first, second], tmp_path / "out").conflicts == ()


def test_folder_that_is_not_empty_is_left_alone(kitchen, tmp_path):
    folders = [write(tmp_path / name, kitchen) for name in ("a", "b")]
    before = (folders[0] / "tasks.jsonl").read_bytes()
    with pytest.raises(DatasetError, match="is not empty: a merge overwrites nothing"):
        merge_datasets(folders, folders[0])
    assert (folders[0] / "tasks.jsonl").read_bytes() == before


def test_damaged_bundle_is_named(kitchen, tmp_path):
    folders = [write(tmp_path / name, kitchen) for name in ("a", "b")]
    (bundle,) = (folders[0] / "bundles").iterdir()
    bundle.write_bytes(b"damaged")
    with pytest.raises(DatasetError, match=r"is damaged: found the digest sha256:.*copy the dataset again"):
        merge_datasets(folders, tmp_path / "out")
    assert not (tmp_path / "out" / "tasks.jsonl").exists()


def test_transcripts_and_trees_come_along(kitchen, tmp_path):
    folders = [write(tmp_path / name, kitchen) for name in ("a", "b")]
    for name, suffix in (("transcripts", "md"), ("trees", "json")):
        (folders[1] / name).mkdir()
        (folders[1] / name / f"b-2.{suffix}").write_text("{}")
    merge_datasets(folders, tmp_path / "out")
    assert (tmp_path / "out" / "transcripts" / "b-2.md").read_text() == "{}"
    assert (tmp_path / "out" / "trees" / "b-2.json").read_text() == "{}"
    sources = json.loads((tmp_path / "out" / "merged.json").read_text())
    assert [source["name"] for source in sources] == ["a", "b"]


def test_command_reports_what_was_left_out(kitchen, tmp_path):
    first = write(tmp_path / "a", kitchen)
    alone = CliRunner().invoke(app, ["merge", str(first), "--out", str(tmp_path / "out")])
    assert alone.exit_code == 2
    assert "expected two or more folders" in " ".join(alone.output.split())
    second = write(tmp_path / "y" / "a", kitchen, split="train")
    command = ["merge", str(first), str(second), "--out", str(tmp_path / "out")]
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    done = CliRunner().invoke(app, [*command, "--resolve", "drop-train"])
    assert done.exit_code == 0, done.output
    assert "4 tasks: 3 for training, 1 held out" in " ".join(done.output.split())
