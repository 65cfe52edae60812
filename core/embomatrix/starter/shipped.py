"""Contents of the package besides code: parts of the corpus, the benchmark that is frozen from it, a small policy."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Final

from embomatrix.starter.archive import packed_records, read_packed
from embomatrix.starter.options import DATASET_VARIABLE, default_dataset
from embomatrix.starter.recipes import PARTS
from embomatrix.world.dataset import (
    TASKS_FILE,
    Dataset,
    DatasetError,
    TaskRecord,
    encode_records,
    record_to_json,
    write_dataset,
)
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

SHIPPED: Final = "shipped"
"""Name of the shipped policy, where a command takes a policy."""
STARTER: Final = "starter"
"""Name of the starter dataset, all tasks that ship, where a folder or a benchmark is asked for."""
VERIFIED: Final = "internal-verified-2"
"""Name of the benchmark of the hardest held-out tasks."""
SEARCH: Final = "search"
"""Name of the dataset of those tasks of the corpus whose things must be searched for."""
FROZEN: Final = (VERIFIED, SEARCH)
"""Names of the lists of tasks that are frozen by id."""
NAMED: Final = (STARTER, *FROZEN)
"""Names of all datasets that ship."""
FROZEN_MARK: Final = b'"digest": "sha256:'
"""Mark of a file of frozen tasks."""
_POLICY: Final = "policy"


@dataclass(frozen=True, slots=True)
class FrozenTasks:
    """Tasks of a frozen benchmark by id, and the digest of their records."""

    digest: str
    tasks: tuple[str, ...]


def archive_of(part: int) -> Path:
    """Return the file of a part of the corpus, which need not exist."""
    return Path(str(resources.files("embomatrix.starter") / f"tasks-{part}.xz"))


def shipped_parts() -> tuple[int, ...]:
    """Return the numbers of the parts that ship."""
    return tuple(part for part in PARTS if archive_of(part).exists())


def unpack_part(folder: Path, part: int) -> None:
    """Write a shipped part to a folder. Raises DatasetError or OSError."""
    records, bundles, _ = read_packed(archive_of(part))
    write_dataset(folder, records, bundles)


def dataset_named(named: str | Path) -> Dataset:
    """Load the dataset in a folder, or a shipped one: ``starter``, ``search`` or ``internal-verified-2``.

    Raises DatasetError or OSError.
    """
    if named in FROZEN and not Path(named).exists():
        return frozen_dataset(str(named))[0]
    return Dataset.load(unpacked_tasks() if named == STARTER else named)


def is_named(folder: Path) -> bool:
    """Return True if this is no folder, but the name of a dataset that ships."""
    return str(folder) in NAMED and not folder.exists()


def open_dataset(folder: Path | None) -> Dataset:
    """Load the dataset in a folder, by its name if it ships, or that of ``dataset_folder``. Raises DatasetError or OSError."""
    if folder is not None and is_named(folder):
        return dataset_named(str(folder))
    return Dataset.load(dataset_folder(folder))


def unpack(folder: Path, parts: Iterable[int] = tuple(PARTS)) -> str:
    """Write shipped parts to a folder as one dataset, by default the starter dataset: all of them.

    Return the digest of the parts' digests. Raises DatasetError or OSError.
    """
    everything: list[TaskRecord] = []
    bundles: dict[str, bytes] = {}
    digests = []
    for part in parts:
        records, contents, digest = read_packed(archive_of(part))
        everything += records
        bundles |= contents
        digests.append(digest)
    write_dataset(folder, everything, bundles)
    return f"sha256:{hashlib.sha256(' '.join(digests).encode('ascii')).hexdigest()}"


def holds_shipped(folder: Path, parts: Iterable[int] = tuple(PARTS)) -> bool:
    """Return True if a folder holds the records of these shipped parts. Bundles are not compared."""
    try:
        dataset = Dataset.load(folder)
    except DatasetError:
        return False
    shipped = [record for part in parts for record in packed_records(archive_of(part))]
    found = json.loads(json.dumps([record_to_json(record) for record in dataset.records]))
    return [{**value, "bundle": 0} for value in found] == [{**value, "bundle": 0} for value in shipped]


def dataset_folder(named: Path | None) -> Path:
    """Return the folder of the dataset to use: the named one, $EMBOMATRIX_DATASET, build/dataset, or the starter dataset.

    The last is unpacked at the first use. Raise DatasetError or OSError.
    """
    if named is not None:
        return named
    folder = default_dataset()
    return folder if os.environ.get(DATASET_VARIABLE) or folder.exists() else unpacked_tasks()


def frozen_file(named: str) -> Path:
    """Return the file of one of the lists in ``FROZEN``, which need not exist."""
    return archive_of(1).with_name(f"{named}.json")


def frozen_dataset(named: str) -> tuple[Dataset, tuple[TaskRecord, ...]]:
    """Return the tasks of one of the lists in ``FROZEN``, and all records that they were chosen from.

    Raises DatasetError for a list that does not ship, and for tasks that are not the frozen ones; or OSError.
    """
    if not frozen_file(named).exists():
        raise DatasetError(
            f"{named} does not ship with this version: pass a dataset folder, or install a newer version"
        )
    frozen = frozen_tasks(frozen_file(named))
    folder = unpacked_tasks()
    records = Dataset.load(folder).records
    ids = frozenset(frozen.tasks)
    chosen = tuple(record for record in records if record.task.task_id in ids)
    found = frozen_digest(chosen)
    if found != frozen.digest:
        raise DatasetError(
            f"the tasks of {named} in {folder} have the digest {found}, expected {frozen.digest}: remove the folder, so "
            "that the shipped tasks are unpacked again"
        )
    return Dataset(folder, chosen), records


def frozen_tasks(path: Path) -> FrozenTasks:
    """Return the tasks of a file that ``freeze`` wrote. Raises DatasetError."""
    try:
        value = parse_json(path.read_bytes())
        return FrozenTasks(str(value["digest"]), tuple(map(str, value["tasks"])))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} names no frozen tasks ({error}): write it again with `embomatrix factory corpus --freeze`, or "
            "`factory search --freeze`"
        ) from error


def freeze(records: Iterable[TaskRecord], file: Path) -> FrozenTasks:
    """Write the ids of records to a file, with the digest of the records. Raises OSError."""
    chosen = tuple(records)
    frozen = FrozenTasks(frozen_digest(chosen), tuple(record.task.task_id for record in chosen))
    write_whole(file, (json.dumps(asdict(frozen), indent=1) + "\n").encode("ascii"))
    return frozen


def frozen_digest(records: Iterable[TaskRecord]) -> str:
    """Return the digest of records without their measured difficulties and the digests of their bundles."""
    data = encode_records(replace(record, difficulty=None, bundle_digest="") for record in records)
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def shipped_policy() -> Path:
    """Return the folder of the shipped policy's checkpoint, with its card."""
    return Path(str(resources.files("embomatrix.starter") / _POLICY))


def demo_settings() -> Path:
    """Return the file with the settings of `embomatrix demo`, for `embomatrix train --settings`."""
    return archive_of(1).with_name("demo.toml")


def unpacked_tasks(parts: Sequence[int] = tuple(PARTS)) -> Path:
    """Return the folder of shipped parts in the user's cache, by default the starter dataset; unpack them if it is missing.

    Raise DatasetError or OSError.
    """
    hashed = hashlib.sha256()
    for part in parts:
        hashed.update(archive_of(part).read_bytes())
    folder = _cache() / f"tasks-{hashed.hexdigest()[:12]}"
    if not (folder / TASKS_FILE).exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Two commands may unpack at once; a command that is interrupted leaves no half dataset.
        with tempfile.TemporaryDirectory(dir=folder.parent) as fresh:
            unpack(Path(fresh) / folder.name, parts)
            if (folder / TASKS_FILE).exists():  # another command was faster, and may be reading it
                return folder
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
