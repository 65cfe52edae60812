"""Corpus: 2,000 training tasks, 200 held-out tasks, and Internal-Verified 2, the hardest of them, frozen under a digest.

Its first part is the shipped dataset. Two builds add training tasks and held-out tasks in other scenes. All parts share its
seed, which splits needs, words, jobs, kinds and goal shapes, so what one part holds out the others hold out too.
"""

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from embomatrix.factory.pipeline.merge import MERGED_FILE, MergeSummary, Resolution, merge_datasets
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.starter.archive import RECIPE
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord, encode_records, write_dataset
from embomatrix.world.difficulty import DifficultyLevel, shuffle_key
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

HELDOUT_SCENES: Final = (
    "Beechwood_0_garden",
    "Pomaria_0_garden",
    "Wainscott_1_int",
    "restaurant_hotel",
    "office_bike",
    "school_chemistry",
)
"""Two gardens of homes that the shipped dataset holds out, a home, a restaurant, an office and a school."""
PARTS: Final = "parts"
STARTER: Final = "starter"
TRAIN: Final = "train"
HELDOUT: Final = "heldout"
"""Folders of the parts in the folder ``PARTS``: the shipped dataset, more training tasks, more held-out tasks."""
TASKS: Final = "tasks"
VERIFIED: Final = "internal-verified-2"
"""Folders of the results: all tasks as one dataset, and the frozen tasks."""
FROZEN_FILE: Final = "frozen.json"


@dataclass(frozen=True, slots=True)
class CorpusSettings:
    """Settings of a corpus. ``train`` and ``heldout`` include the shipped dataset, ``scenes`` and ``unseen`` don't.

    ``scenes`` are those of the added training tasks, ``unseen`` those of the added held-out tasks. Equal settings give equal
    corpora.
    """

    train: int = 2_000
    heldout: int = 200
    scenes: tuple[str, ...] = ()
    unseen: tuple[str, ...] = HELDOUT_SCENES
    look_ahead: bool = True
    physical: bool = True

    def builds(self, starter: Dataset) -> dict[str, BuildSettings]:
        """Return the settings of the builds by part. Raises DatasetError if the shipped dataset is as large already."""
        train, heldout = self.train - len(starter.train), self.heldout - len(starter.heldout)
        if min(train, heldout) < 0 or not max(train, heldout):
            raise DatasetError(
                f"the shipped dataset, which is part of the corpus, has {len(starter.train)} training and "
                f"{len(starter.heldout)} held-out tasks: found --train {self.train} --heldout {self.heldout}, expected more"
            )
        known = {base_scene_of(record.task.scene_id) for record in starter.records}
        scenes = self.scenes or tuple(
            scene for scene in Catalog.load().scene_ids if scene not in known and scene not in self.unseen
        )
        how = (WriterKind.SOCIAL, self.look_ahead, self.physical)
        builds = {
            TRAIN: BuildSettings(train, 0, RECIPE.seed, scenes, *how),
            HELDOUT: BuildSettings(0, heldout, RECIPE.seed, self.unseen, *how),
        }
        return {part: build for part, build in builds.items() if build.train or build.heldout}


@dataclass(frozen=True, slots=True)
class Frozen:
    """Contents of Internal-Verified 2. ``digest`` covers the records, which name their bundles by digest."""

    tasks: int
    scenes: tuple[str, ...]
    digest: str


def training_scenes() -> tuple[str, ...]:
    """Return all base scenes but those of the added held-out tasks."""
    return tuple(scene for scene in Catalog.load().scene_ids if scene not in HELDOUT_SCENES)


def part_folder(folder: Path, part: str) -> Path:
    """Return the folder of a part of the corpus."""
    return folder / PARTS / part


def check_free(folder: Path) -> None:
    """Raise DatasetError if the folder holds tasks that no earlier build of a corpus wrote."""
    for name, mark in ((TASKS, MERGED_FILE), (VERIFIED, FROZEN_FILE)):
        path = folder / name
        if path.exists() and not (path / mark).exists() and (not path.is_dir() or any(path.iterdir())):
            raise DatasetError(
                f"{path} was not written by `factory corpus`: name another folder with --out, or move it away"
            )


def join_parts(folder: Path, parts: Sequence[str]) -> MergeSummary:
    """Write the tasks of the parts as one dataset. A training task that gives a held-out one away is left out.

    Raises DatasetError if a scene is on both sides, or OSError.
    """
    shutil.rmtree(folder / TASKS, ignore_errors=True)
    joined = merge_datasets(
        [part_folder(folder, part) for part in parts], folder / TASKS, Resolution.DROP_TRAIN
    )
    _check_apart(joined.records)
    return joined


def freeze(folder: Path, measured: Sequence[TaskRecord], count: int) -> Frozen:
    """Store the measured difficulty of all tasks and freeze the hardest ``count`` held-out ones. Raises DatasetError."""
    dataset = Dataset.load(folder / TASKS)
    write_dataset(dataset.folder, measured, {})
    target = folder / VERIFIED
    chosen = _hardest([record for record in measured if record.split == "heldout"], count)
    digests = dict.fromkeys(record.bundle_digest for record in chosen)
    write_dataset(target, chosen, {digest: dataset.bundle_bytes(digest) for digest in digests})
    frozen = _frozen(target)
    write_whole(target / FROZEN_FILE, (json.dumps(asdict(frozen), indent=1) + "\n").encode("ascii"))
    return frozen


def _hardest(records: Sequence[TaskRecord], count: int) -> list[TaskRecord]:
    """Return the hardest records in their order."""

    def rank(record: TaskRecord) -> tuple[int, bytes]:
        level = DifficultyLevel.EASY if record.difficulty is None else record.difficulty.level
        return -list(DifficultyLevel).index(level), shuffle_key(record.task.task_id)

    chosen = {record.task.task_id for record in sorted(records, key=rank)[:count]}
    return [record for record in records if record.task.task_id in chosen]


def check_frozen(folder: Path) -> Frozen:
    """Check that a corpus matches its frozen digest and that training is separate from it. Raises DatasetError."""
    path = folder / VERIFIED / FROZEN_FILE
    try:
        value = parse_json(path.read_bytes())
        recorded = Frozen(value["tasks"], tuple(value["scenes"]), value["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} does not describe a frozen corpus ({error}): build the corpus again"
        ) from error
    verified = Dataset.load(folder / VERIFIED)
    found = _frozen(folder / VERIFIED)
    if found != recorded:
        raise DatasetError(
            f"{folder / VERIFIED} differs from the frozen corpus: found {found.tasks} tasks with digest "
            f"{found.digest}, expected "
            f"{recorded.tasks} with {recorded.digest}; restore the folder from a backup"
        )
    for record in verified.records:
        verified.bundle(record.bundle_digest)
    _check_apart([*Dataset.load(folder / TASKS).train, *verified.records])
    return recorded


def _frozen(folder: Path) -> Frozen:
    records = Dataset.load(folder).records
    data = encode_records(replace(record, difficulty=None) for record in records)
    scenes = tuple(sorted({base_scene_of(record.task.scene_id) for record in records}))
    return Frozen(len(records), scenes, f"sha256:{hashlib.sha256(data).hexdigest()}")


def _check_apart(records: Sequence[TaskRecord]) -> None:
    """Raise DatasetError if training and held-out tasks share an instruction or a scene."""
    train, heldout = (
        [record for record in records if record.split == split] for split in ("train", "heldout")
    )
    said = {record.task.instruction for record in train} & {record.task.instruction for record in heldout}
    if said:
        raise DatasetError(
            f"the instruction {min(said)!r} is trained on and held out: use one seed for all parts"
        )
    shared = {base_scene_of(record.task.scene_id) for record in train} & {
        base_scene_of(record.task.scene_id) for record in heldout
    }
    if shared:
        raise DatasetError(
            f"tasks in {min(shared)} are trained on and held out: name other scenes with --scenes or --unseen"
        )
