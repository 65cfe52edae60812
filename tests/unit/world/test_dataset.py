"""Datasets survive the disk, read bundles on demand, and explain damaged folders."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import (
    TASKS_FILE,
    Dataset,
    DatasetError,
    TaskRecord,
    encode_records,
    record_to_json,
    write_dataset,
)
from embomatrix.world.difficulty import Difficulty, DifficultyLevel
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.task import Task

PLAN = ({"action": "move", "object_index": 1}, {"action": "open", "object_index": 1})


def write(folder: Path, bundle: Bundle, task: Task) -> TaskRecord:
    data = encode_bundle(bundle)
    record = TaskRecord(task, bundle_digest(data), "train", PLAN, ("kitchen_0",), "open(fridge)")
    write_dataset(folder, [record], {record.bundle_digest: data})
    return record


def test_dataset_survives_the_disk(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    record = write(tmp_path, bundle, task)
    dataset = Dataset.load(tmp_path)
    assert dataset.records == (record,)
    assert dataset.train == (record,)
    assert dataset.heldout == ()
    assert dataset.bundle(record.bundle_digest) == bundle
    assert dataset.bundle(record.bundle_digest) is dataset.bundle(record.bundle_digest)


def test_unknown_task_suggests_a_close_name(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    write(tmp_path, bundle, task)
    with pytest.raises(DatasetError, match="did you mean tiny-1-open"):
        Dataset.load(tmp_path).find("tiny-1-opn")


def test_folder_without_a_dataset_suggests_the_build_command(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="factory starter"):
        Dataset.load(tmp_path / "nothing")


def test_broken_line_is_named_by_its_number(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    write(tmp_path, bundle, task)
    with (tmp_path / "tasks.jsonl").open("a") as file:
        file.write('{"task": \n')
    with pytest.raises(DatasetError, match=r"tasks.jsonl:2"):
        Dataset.load(tmp_path)


def test_unknown_split_names_the_field(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    value = record_to_json(write(tmp_path, bundle, task)) | {"split": "test"}
    (tmp_path / "tasks.jsonl").write_text(json.dumps(value))
    with pytest.raises(DatasetError, match=r"record\.split"):
        Dataset.load(tmp_path)


def test_missing_and_damaged_bundles_are_named(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    record = write(tmp_path, bundle, task)
    file = next((tmp_path / "bundles").iterdir())
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(
        DatasetError, match=rf"{file} of the dataset is damaged .* expected {record.bundle_digest}"
    ):
        Dataset.load(tmp_path).bundle(record.bundle_digest)
    with file.open("wb") as opened:
        opened.truncate(1 << 30)
    with pytest.raises(DatasetError, match=r"can't be read \(it has over 8,388,608 bytes\)"):
        Dataset.load(tmp_path).bundle(record.bundle_digest)
    file.unlink()
    with pytest.raises(
        DatasetError, match=r"can't be read.*: copy the dataset again, or get the shipped one"
    ):
        Dataset.load(tmp_path).bundle(record.bundle_digest)


@pytest.mark.parametrize("text", ["[" * 100_000, r'{"task": "\ud800"}'])
def test_line_that_no_program_can_carry_is_damaged(tmp_path: Path, text: str) -> None:
    (tmp_path / TASKS_FILE).write_text(text)
    with pytest.raises(DatasetError, match=r"tasks\.jsonl:1 is damaged: .*(nested too deep|surrogate pair)"):
        Dataset.load(tmp_path)


def test_instruction_with_any_line_separator_is_one_line(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    value = record_to_json(write(tmp_path, bundle, task))
    value["task"]["instruction"] = "Open\u2028the\x85fridge."
    (tmp_path / TASKS_FILE).write_text(json.dumps(value, ensure_ascii=False), encoding="utf-8")
    assert Dataset.load(tmp_path).records[0].task.instruction == "Open\u2028the\x85fridge."


@pytest.mark.parametrize("digest", ["", "sha256:../../etc/passwd", "md5:00", "sha256:" + "g" * 64])
def test_malformed_digest_never_becomes_a_path(
    tmp_path: Path, bundle: Bundle, task: Task, digest: str
) -> None:
    write(tmp_path, bundle, task)
    with pytest.raises(DatasetError, match="64 hexadecimal digits"):
        Dataset.load(tmp_path).bundle_bytes(digest)


@pytest.mark.parametrize("digest", ["Atlantis", "sha256:" + "g" * 64])
def test_record_with_a_malformed_digest_is_named_by_its_line(
    tmp_path: Path, bundle: Bundle, task: Task, digest: str
) -> None:
    record = write(tmp_path, bundle, task)
    tasks = tmp_path / TASKS_FILE
    tasks.write_text(tasks.read_text().replace(record.bundle_digest, digest))
    with pytest.raises(DatasetError, match=r"tasks.jsonl:1 is damaged: .*bundle.* 64 hexadecimal digits"):
        Dataset.load(tmp_path)


def test_measured_difficulty_survives_the_disk(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    record = write(tmp_path, bundle, task)
    assert "difficulty" not in record_to_json(record)
    measured = replace(record, difficulty=Difficulty(True, False, True, 2, 0.25))
    (tmp_path / TASKS_FILE).write_bytes(encode_records([measured]))
    assert Dataset.load(tmp_path).records == (measured,)


def test_difficulty_of_impossible_values_names_the_field(tmp_path: Path, bundle: Bundle, task: Task) -> None:
    measured = replace(write(tmp_path, bundle, task), difficulty=Difficulty(True, True, True, 2, 1.5))
    (tmp_path / TASKS_FILE).write_bytes(encode_records([measured]))
    with pytest.raises(DatasetError, match=r"difficulty\.small_policy"):
        Dataset.load(tmp_path)


@pytest.mark.parametrize(
    ("nearest", "template", "level"),
    [
        (True, True, DifficultyLevel.EASY),
        (True, False, DifficultyLevel.EASY),
        (False, True, DifficultyLevel.MEDIUM),
        (False, False, DifficultyLevel.HARD),
    ],
)
def test_level_is_that_of_the_weakest_script_that_succeeds(
    nearest: bool, template: bool, level: DifficultyLevel
) -> None:
    assert Difficulty(template, nearest, True, 4).level is level
