"""Corpus: training tasks in 45 scenes, held-out tasks, and Internal-Verified 2, the hardest of them, frozen under a digest.

Two builds share one seed, which splits needs, words, jobs, kinds and goal shapes, so what one build holds out the other
holds out too. More than half of the held-out tasks lie in six scenes that are in no training build.
"""

import hashlib
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord, encode_records, write_dataset
from embomatrix.world.difficulty import DifficultyLevel
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

HELDOUT_SCENES: Final = (
    "Ihlen_1_int",
    "Wainscott_1_int",
    "Beechwood_1_int",
    "restaurant_hotel",
    "office_bike",
    "school_chemistry",
)
"""Three homes, a restaurant, an office and a school. Each kind of place keeps enough other scenes for training."""
TRAIN: Final = "train"
UNSEEN: Final = "unseen"
HELDOUT: Final = "heldout"
VERIFIED: Final = "internal-verified-2"
"""Folders of a corpus: training build, build in unseen scenes, the held-out tasks of both, and the frozen ones."""
FROZEN_FILE: Final = "frozen.json"
UNSEEN_SHARE: Final = 0.6
"""Share of the held-out tasks in scenes that training never sees."""


@dataclass(frozen=True, slots=True)
class CorpusSettings:
    """Settings of a corpus.

    ``scenes`` are those of training, ``unseen`` those of the second build. ``verified`` is the number of frozen tasks. Equal
    settings give equal corpora.
    """

    train: int = 2_000
    heldout: int = 200
    verified: int = 100
    seed: int = 0
    scenes: tuple[str, ...] = ()
    unseen: tuple[str, ...] = HELDOUT_SCENES
    look_ahead: bool = True
    physical: bool = True

    def builds(self) -> dict[str, BuildSettings]:
        """Return the settings of both builds by folder."""
        away = round(self.heldout * UNSEEN_SHARE)
        scenes = self.scenes or training_scenes()
        how = (WriterKind.SOCIAL, self.look_ahead, self.physical)
        return {
            TRAIN: BuildSettings(self.train, self.heldout - away, self.seed, scenes, *how),
            UNSEEN: BuildSettings(0, away, self.seed, self.unseen, *how),
        }


@dataclass(frozen=True, slots=True)
class Frozen:
    """Contents of Internal-Verified 2. ``digest`` covers the records, which name their bundles by digest."""

    tasks: int
    unseen: int
    scenes: tuple[str, ...]
    digest: str


def training_scenes() -> tuple[str, ...]:
    """Return all base scenes but the held-out ones."""
    return tuple(scene for scene in Catalog.load().scene_ids if scene not in HELDOUT_SCENES)


def gather_heldout(folder: Path) -> Dataset:
    """Write the held-out tasks of both builds into one folder and return it. Raise DatasetError if training shares any."""
    builds = [Dataset.load(folder / name) for name in (TRAIN, UNSEEN)]
    records = [record for build in builds for record in build.heldout]
    _check_apart(builds[0].train, records)
    bundles = {
        record.bundle_digest: build.bundle_bytes(record.bundle_digest)
        for build in builds
        for record in build.heldout
    }
    write_dataset(folder / HELDOUT, records, bundles)
    return Dataset.load(folder / HELDOUT)


def freeze(folder: Path, measured: Sequence[TaskRecord], count: int) -> Frozen:
    """Freeze the hardest ``count`` held-out tasks, most of them in unseen scenes. Raise DatasetError.

    ``measured`` are the records of ``gather_heldout`` with their difficulty.
    """
    heldout = Dataset.load(folder / HELDOUT)
    train = Dataset.load(folder / TRAIN).train
    trained_in = {base_scene_of(record.task.scene_id) for record in train}
    records = _hardest(measured, trained_in, count)
    _check_apart(train, records)
    target = folder / VERIFIED
    digests = dict.fromkeys(record.bundle_digest for record in records)
    write_dataset(target, records, {digest: heldout.bundle_bytes(digest) for digest in digests})
    frozen = _frozen(target, trained_in)
    write_whole(target / FROZEN_FILE, (json.dumps(asdict(frozen), indent=1) + "\n").encode("ascii"))
    return frozen


def _hardest(records: Sequence[TaskRecord], trained_in: Collection[str], count: int) -> list[TaskRecord]:
    """Return the hardest records of unseen scenes and of others, in their order. The task id decides between equals."""

    def rank(record: TaskRecord) -> tuple[int, bytes]:
        level = DifficultyLevel.EASY if record.difficulty is None else record.difficulty.level
        return -list(DifficultyLevel).index(level), hashlib.sha256(record.task.task_id.encode()).digest()

    ordered = sorted(records, key=rank)
    unseen = [record for record in ordered if base_scene_of(record.task.scene_id) not in trained_in]
    seen = [record for record in ordered if base_scene_of(record.task.scene_id) in trained_in]
    away = max(min(len(unseen), round(count * UNSEEN_SHARE)), count - len(seen))
    chosen = {record.task.task_id for record in (*unseen[:away], *seen[: count - away])}
    return [record for record in records if record.task.task_id in chosen]


def check_frozen(folder: Path) -> Frozen:
    """Check that a corpus matches its frozen digest and that training is separate from it. Raise DatasetError."""
    path = folder / VERIFIED / FROZEN_FILE
    try:
        value = parse_json(path.read_bytes())
        recorded = Frozen(value["tasks"], value["unseen"], tuple(value["scenes"]), value["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} does not describe a frozen corpus ({error}): build the corpus again"
        ) from error
    train = Dataset.load(folder / TRAIN).train
    verified = Dataset.load(folder / VERIFIED)
    found = _frozen(folder / VERIFIED, {base_scene_of(record.task.scene_id) for record in train})
    if found != recorded:
        raise DatasetError(
            f"{folder / VERIFIED} differs from the frozen corpus: found {found.tasks} tasks with digest "
            f"{found.digest}, expected "
            f"{recorded.tasks} with {recorded.digest}; restore the folder from a backup"
        )
    for record in verified.records:
        verified.bundle(record.bundle_digest)
    _check_apart(train, verified.records)
    return recorded


def _frozen(folder: Path, trained_in: set[str]) -> Frozen:
    records = Dataset.load(folder).records
    data = encode_records(replace(record, difficulty=None) for record in records)
    bases = tuple(sorted({base_scene_of(record.task.scene_id) for record in records}))
    unseen = sum(base_scene_of(record.task.scene_id) not in trained_in for record in records)
    return Frozen(len(records), unseen, bases, f"sha256:{hashlib.sha256(data).hexdigest()}")


def _check_apart(train: Sequence[TaskRecord], heldout: Sequence[TaskRecord]) -> None:
    """Raise DatasetError if both sides share an instruction or a goal in a scene, or most held-out tasks a trained scene."""
    said = {record.task.instruction for record in train} & {record.task.instruction for record in heldout}
    if said:
        raise DatasetError(
            f"the instruction {min(said)!r} is trained on and held out: use one seed for both builds"
        )
    shared = _goals_by_scene(train) & _goals_by_scene(heldout)
    if shared:
        scene, signature = min(shared)
        raise DatasetError(
            f"goals with the signature {signature!r} in {scene} are trained on and held out: use one seed for both builds"
        )
    trained_in = {base_scene_of(record.task.scene_id) for record in train}
    seen = sum(base_scene_of(record.task.scene_id) in trained_in for record in heldout)
    if 2 * seen > len(heldout):
        raise DatasetError(
            f"{seen} of {len(heldout)} held-out tasks lie in scenes of training: expected at most half; the unseen "
            "scenes yielded too few"
        )


def _goals_by_scene(records: Sequence[TaskRecord]) -> set[tuple[str, str]]:
    return {(base_scene_of(record.task.scene_id), record.signature) for record in records}
