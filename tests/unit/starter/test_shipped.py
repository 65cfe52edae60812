"""Choice of the dataset that a command uses, and unpacking of the shipped tasks."""

from pathlib import Path

import pytest

from embomatrix.starter import shipped
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET
from embomatrix.world.dataset import TASKS_FILE


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Folders to which tasks are unpacked, by a stand-in that takes no seconds."""
    folders: list[Path] = []

    def unpack(folder: Path) -> str:
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
