"""Choice of the dataset that a command uses, unpacking of the shipped tasks, and what ships."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from embomatrix.starter import shipped
from embomatrix.starter.archive import read_packed
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET
from embomatrix.starter.recipes import PARTS
from embomatrix.starter.shipped import (
    SEARCH,
    VERIFIED,
    archive_of,
    frozen_file,
    frozen_tasks,
    holds_shipped,
    shipped_parts,
    unpack,
)
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import DifficultyLevel
from embomatrix.world.task import TaskCategory


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Folders to which tasks are unpacked, by a stand-in that takes no seconds."""
    folders: list[Path] = []

    def unpack(folder: Path, parts: Sequence[int]) -> str:
        assert tuple(parts) == tuple(PARTS)
        folder.mkdir()
        (folder / TASKS_FILE).write_text("{}\n")
        folders.append(folder)
        return "sha256:"

    monkeypatch.setattr(shipped, "unpack", unpack)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(DATASET_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    return folders


def test_named_folder_comes_before_the_variable_and_the_default(
    unpacked: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    DEFAULT_DATASET.mkdir(parents=True)
    assert shipped.dataset_folder(Path("mine")) == Path("mine")
    assert shipped.dataset_folder(None) == DEFAULT_DATASET
    monkeypatch.setenv(DATASET_VARIABLE, "other")
    assert shipped.dataset_folder(None) == Path("other")
    assert not unpacked


def test_shipped_tasks_are_unpacked_once_and_again_if_they_are_incomplete(
    unpacked: list[Path], tmp_path: Path
) -> None:
    folder = shipped.dataset_folder(None)
    assert folder.parent == tmp_path / "cache" / "embomatrix"
    assert shipped.dataset_folder(None) == folder
    assert len(unpacked) == 1
    (folder / TASKS_FILE).unlink()
    assert (shipped.dataset_folder(None) / TASKS_FILE).exists()
    assert len(unpacked) == 2
    assert [each.name for each in folder.parent.iterdir()] == [folder.name]


@pytest.fixture(scope="module")
def tasks(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The shipped tasks."""
    folder = tmp_path_factory.mktemp("tasks")
    unpack(folder)
    return Dataset.load(folder)


def test_starter_dataset_has_held_out_tasks_in_scenes_of_their_own(tasks: Dataset) -> None:
    assert len(tasks.train) == sum(recipe.train for recipe in PARTS.values())
    assert len(tasks.heldout) == sum(recipe.heldout for recipe in PARTS.values())
    scenes = {
        split: {record.task.scene_id.partition("-")[0] for record in records}
        for split, records in (("train", tasks.train), ("heldout", tasks.heldout))
    }
    assert not scenes["train"] & scenes["heldout"]
    assert len(scenes["train"]) == 43
    assert len({record.task.task_id for record in tasks.records}) == len(tasks.records)
    for record in tasks.records[::10]:
        assert record.task.task_id in tasks.read_bundle(record.bundle_digest).tasks


def test_shipped_parts_have_the_tasks_of_their_recipes_each_with_its_difficulty() -> None:
    assert shipped_parts() == tuple(PARTS)
    for part in shipped_parts():
        recipe, (records, *_) = PARTS[part], read_packed(archive_of(part))
        counts = Counter(record.split for record in records)
        assert counts == +Counter(train=recipe.train, heldout=recipe.heldout), f"part {part}"
        assert {record.task.scene_id.partition("-")[0] for record in records} <= set(recipe.scenes)
        assert len({record.task.task_id for record in records}) == len(records)
        assert all(record.difficulty is not None for record in records)


def test_recipes_make_2000_training_and_200_held_out_tasks_in_all_scenes() -> None:
    scenes = [scene for recipe in PARTS.values() for scene in recipe.scenes]
    assert sorted(scenes) == sorted(Catalog.load().scene_ids)
    assert sum(recipe.train for recipe in PARTS.values()) == 2_000
    assert sum(recipe.heldout for recipe in PARTS.values()) == 200


def test_a_folder_with_the_shipped_tasks_is_recognised(tasks: Dataset, tmp_path: Path) -> None:
    assert holds_shipped(tasks.folder)
    write_dataset(tmp_path / "less", tasks.records[1:], {})
    assert not holds_shipped(tmp_path / "less")
    assert not holds_shipped(tmp_path)


def test_frozen_tasks_are_the_hardest_held_out_ones(tasks: Dataset) -> None:
    frozen = frozen_tasks(frozen_file(VERIFIED))
    chosen = [record for record in tasks.heldout if record.task.task_id in set(frozen.tasks)]
    left = [record for record in tasks.heldout if record.task.task_id not in set(frozen.tasks)]
    assert len(chosen) == len(frozen.tasks) == 100
    assert frozen.digest == shipped.frozen_digest(chosen)
    ranks = list(DifficultyLevel)
    easiest = min(ranks.index(record.difficulty.level) for record in chosen if record.difficulty)
    assert easiest >= max(ranks.index(record.difficulty.level) for record in left if record.difficulty)


def test_frozen_searches_are_in_both_splits_and_all_categories() -> None:
    frozen = frozen_tasks(frozen_file(SEARCH))
    records = [record for part in shipped_parts() for record in read_packed(archive_of(part))[0]]
    chosen = [record for record in records if record.task.task_id in set(frozen.tasks)]
    assert len(chosen) == len(frozen.tasks)
    assert frozen.digest == shipped.frozen_digest(chosen)
    for split, least in (("train", 500), ("heldout", 60)):
        categories = Counter(record.task.category for record in chosen if record.split == split)
        assert categories.total() >= least
        assert set(categories) == set(TaskCategory)


def test_damaged_list_of_frozen_tasks_is_reported(tmp_path: Path) -> None:
    (tmp_path / "frozen.json").write_text("[]")
    with pytest.raises(DatasetError, match=r"frozen\.json names no frozen tasks .*: write it again"):
        frozen_tasks(tmp_path / "frozen.json")
