"""The shipped dataset unpacks to what was packed, whatever the system's zlib, and damage is reported."""

import lzma
import zlib
from pathlib import Path

import pytest
from tests.fakes.datasets import write_kitchen_dataset

from embomatrix.starter import archive
from embomatrix.starter.archive import RECIPE, content_digest, pack, unpack
from embomatrix.world.dataset import Dataset, DatasetError


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def test_unpacked_dataset_has_the_tasks_and_bundles_that_were_packed(
    tmp_path: Path, kitchen: Dataset
) -> None:
    digest = pack(kitchen, tmp_path / "packed.xz")
    assert unpack(tmp_path / "again", tmp_path / "packed.xz") == digest == content_digest(kitchen)
    again = Dataset.load(tmp_path / "again")
    assert again.records == kitchen.records
    for record in again.records:
        assert again.bundle(record.bundle_digest) == kitchen.bundle(record.bundle_digest)


def test_another_compression_changes_no_content(
    tmp_path: Path, kitchen: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = pack(kitchen, tmp_path / "packed.xz")
    monkeypatch.setattr(archive, "LEVEL", zlib.Z_BEST_SPEED)
    assert unpack(tmp_path / "again", tmp_path / "packed.xz") == digest
    again = Dataset.load(tmp_path / "again")
    assert {record.bundle_digest for record in again.records}.isdisjoint(
        record.bundle_digest for record in kitchen.records
    )
    assert content_digest(again) == digest
    assert [record.task for record in again.records] == [record.task for record in kitchen.records]


@pytest.mark.parametrize("damage", ["cut", "other", "head"])
def test_damaged_file_is_reported_and_writes_nothing(tmp_path: Path, kitchen: Dataset, damage: str) -> None:
    file = tmp_path / "packed.xz"
    pack(kitchen, file)
    data = file.read_bytes()
    file.write_bytes(
        {"cut": data[: len(data) // 2], "other": b"not xz", "head": lzma.compress(b'{"sizes": [4]}\nabcd')}[
            damage
        ]
    )
    with pytest.raises(DatasetError, match=r"packed\.xz is no packed dataset .*: install the package again"):
        unpack(tmp_path / "again", file)
    assert not (tmp_path / "again" / "tasks.jsonl").exists()


def test_the_package_ships_proved_tasks_in_many_scenes(tmp_path: Path) -> None:
    unpack(tmp_path)
    shipped = Dataset.load(tmp_path)
    assert (len(shipped.train), len(shipped.heldout)) == (RECIPE.train, RECIPE.heldout)
    scenes = {
        split: {record.task.scene_id.partition("-")[0] for record in records}
        for split, records in (("train", shipped.train), ("heldout", shipped.heldout))
    }
    assert not scenes["train"] & scenes["heldout"]
    assert len(scenes["train"]) >= 10
    assert all(record.difficulty is not None for record in shipped.records)
    for record in shipped.records[::10]:
        assert record.task.task_id in shipped.read_bundle(record.bundle_digest).tasks
