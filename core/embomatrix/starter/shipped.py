"""Places of what ships with the package: the tasks, unpacked once for each user, and a trained small policy."""

import hashlib
import os
import shutil
import tempfile
from importlib import resources
from pathlib import Path
from typing import Final

from embomatrix.starter.archive import ARCHIVE, unpack
from embomatrix.starter.options import DATASET_VARIABLE, default_dataset
from embomatrix.world.dataset import TASKS_FILE

SHIPPED: Final = "shipped"
"""Name of the shipped policy, where a command takes a policy."""
_POLICY: Final = "policy"


def dataset_folder(named: Path | None) -> Path:
    """Return the folder of the dataset to use: the named one, $EMBOMATRIX_DATASET, build/dataset, or the shipped tasks.

    The last are unpacked at the first use. Raise DatasetError or OSError.
    """
    if named is not None:
        return named
    folder = default_dataset()
    return folder if os.environ.get(DATASET_VARIABLE) or folder.exists() else _unpacked_tasks()


def shipped_policy() -> Path:
    """Return the folder of the shipped policy's checkpoint, with its card."""
    return Path(str(resources.files("embomatrix.starter") / _POLICY))


def _unpacked_tasks() -> Path:
    """Return the folder of the shipped tasks in the user's cache, and unpack them there if they are missing."""
    archive = (resources.files("embomatrix.starter") / ARCHIVE).read_bytes()
    folder = _cache() / f"tasks-{hashlib.sha256(archive).hexdigest()[:12]}"
    if not (folder / TASKS_FILE).exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Two commands may unpack at once; a command that is interrupted leaves no half dataset.
        with tempfile.TemporaryDirectory(dir=folder.parent) as fresh:
            unpack(Path(fresh) / folder.name)
            shutil.rmtree(folder, ignore_errors=True)
            try:
                (Path(fresh) / folder.name).replace(folder)
            except OSError:
                if not (folder / TASKS_FILE).exists():
                    raise
    return folder


def _cache() -> Path:
    """Return the folder for files that can be made again (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "embomatrix"
