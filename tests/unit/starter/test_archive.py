"""A packed dataset unpacks to what was packed, whatever the system's zlib, and damage is reported."""

import dataclasses
import lzma
import zlib
from pathlib import Path

import pytest
from tests.fakes.datasets import write_kitchen_dataset

from embomatrix.starter import archive
from embomatrix.starter.archive import content_digest, pack, read_packed
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import Difficulty


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def _unpacked(folder: Path, file: Path) -> tuple[Dataset, str]:
    records, bundles, digest = read_packed(file)
    write_dataset(folder, records, bundles)
    return Dataset.load(folder), digest


def test_unpacked_dataset_has_the_tasks_and_bundles_that_were_packed(
    tmp_path: Path, kitchen: Dataset
) -> None:
    packed = pack(kitchen, tmp_path / "packed.xz")
    again, digest = _unpacked(tmp_path / "again", tmp_path / "packed.xz")
    assert digest == packed == content_digest(kitchen)
    assert again.records == kitchen.records
    for record in again.records:
        assert again.bundle(record.bundle_digest) == kitchen.bundle(record.bundle_digest)


def test_another_compression_changes_no_content(
    tmp_path: Path, kitchen: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = pack(kitchen, tmp_path / "packed.xz")
    monkeypatch.setattr(archive, "LEVEL", zlib.Z_BEST_SPEED)
    again, digest = _unpacked(tmp_path / "again", tmp_path / "packed.xz")
    assert {record.bundle_digest for record in again.records}.isdisjoint(
        record.bundle_digest for record in kitchen.records
    )
    assert content_digest(again) == digest == packed
    assert [record.task for record in again.records] == [record.task for record in kitchen.records]


def test_the_digest_covers_words_and_not_measured_difficulties(tmp_path: Path, kitchen: Dataset) -> None:
    hard = Difficulty(False, False, True, 4, None)
    measured = [dataclasses.replace(record, difficulty=hard) for record in kitchen.records]
    digest = pack(Dataset(kitchen.folder, tuple(measured)), tmp_path / "packed.xz")
    assert digest == content_digest(kitchen) == read_packed(tmp_path / "packed.xz")[2]
    assert read_packed(tmp_path / "packed.xz")[0] == measured
    other = dataclasses.replace(
        measured[0], task=dataclasses.replace(measured[0].task, instruction="Do something else.")
    )
    assert content_digest(Dataset(kitchen.folder, (other, *measured[1:]))) != digest


@pytest.mark.parametrize("damage", ["cut", "other", "head"])
def test_damaged_file_is_reported(tmp_path: Path, kitchen: Dataset, damage: str) -> None:
    file = tmp_path / "packed.xz"
    pack(kitchen, file)
    data = file.read_bytes()
    file.write_bytes(
        {"cut": data[: len(data) // 2], "other": b"not xz", "head": lzma.compress(b'{"sizes": [4]}\nabcd')}[
            damage
        ]
    )
    with pytest.raises(DatasetError, match=r"packed\.xz is no packed dataset .*: install the package again"):
        read_packed(file)
