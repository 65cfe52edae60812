"""The corpora: tasks to train on in 45 scenes, and Internal-Verified, held-out tasks that are frozen under a digest.

Both come of builds with one seed, by which goal signatures are dealt out: what is held out in one build is held out in the
other. More than half of Internal-Verified lies in six scenes that training never sees, the rest in rooms that it never sees.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, write_dataset
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from embomatrix.world.dataset import TaskRecord

HELDOUT_SCENES: Final = (
    "Ihlen_1_int",
    "Wainscott_1_int",
    "Beechwood_1_int",
    "restaurant_hotel",
    "office_bike",
    "school_chemistry",
)
"""Three homes, a restaurant, an office and a school: of every milieu with enough scenes to spare one."""
TRAIN: Final = "train"
UNSEEN: Final = "unseen"
VERIFIED: Final = "internal-verified"
"""Folders of a corpus: what is trained on, the build in unseen scenes, and the frozen tasks."""
FROZEN_FILE: Final = "frozen.json"
UNSEEN_SHARE: Final = 0.6
"""Of the held-out tasks, those in scenes that training never sees."""


@dataclass(frozen=True, slots=True)
class CorpusSettings:
    """Equal settings give equal corpora. ``scenes`` and ``unseen`` are the scenes of training and of the rest."""

    train: int = 2_000
    heldout: int = 100
    seed: int = 0
    scenes: tuple[str, ...] = ()
    unseen: tuple[str, ...] = HELDOUT_SCENES
    look_ahead: bool = True
    physical: bool = True

    def builds(self) -> dict[str, BuildSettings]:
        """The builds of the corpus by folder."""
        away = round(self.heldout * UNSEEN_SHARE)
        scenes = self.scenes or training_scenes()
        how = (WriterKind.SOCIAL, self.look_ahead, self.physical)
        return {
            TRAIN: BuildSettings(self.train, self.heldout - away, self.seed, scenes, *how),
            UNSEEN: BuildSettings(0, away, self.seed, self.unseen, *how),
        }


@dataclass(frozen=True, slots=True)
class Frozen:
    """What Internal-Verified is: ``digest`` is over its records, which name their bundles by digest."""

    tasks: int
    unseen: int
    scenes: tuple[str, ...]
    digest: str


def training_scenes() -> tuple[str, ...]:
    """All base scenes but the held-out ones."""
    return tuple(scene for scene in Catalog.load().scene_ids if scene not in HELDOUT_SCENES)


def freeze(folder: Path) -> Frozen:
    """Put the held-out tasks of both builds together and write down what they are. Raises DatasetError."""
    builds = [Dataset.load(folder / name) for name in (TRAIN, UNSEEN)]
    train = builds[0].train
    records = [record for build in builds for record in build.heldout]
    _check_apart(train, records)
    bundles = {
        record.bundle_digest: build.bundle_bytes(record.bundle_digest)
        for build in builds
        for record in build.heldout
    }
    target = folder / VERIFIED
    write_dataset(target, records, bundles)
    frozen = _frozen(target, {_base(record) for record in train})
    write_whole(target / FROZEN_FILE, (json.dumps(asdict(frozen), indent=1) + "\n").encode("ascii"))
    return frozen


def check_frozen(folder: Path) -> Frozen:
    """Whether a corpus is still what was frozen, and training is apart from it. Raises DatasetError with what is not so."""
    path = folder / VERIFIED / FROZEN_FILE
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        said = Frozen(value["tasks"], value["unseen"], tuple(value["scenes"]), value["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} does not tell what was frozen ({error}): make the corpus again"
        ) from error
    train = Dataset.load(folder / TRAIN).train
    verified = Dataset.load(folder / VERIFIED)
    found = _frozen(folder / VERIFIED, {_base(record) for record in train})
    if found != said:
        raise DatasetError(
            f"{folder / VERIFIED} is not what was frozen: found {found.tasks} tasks with digest {found.digest}, expected "
            f"{said.tasks} with {said.digest}; take the folder back from where it was kept"
        )
    for record in verified.records:
        verified.bundle(record.bundle_digest)
    _check_apart(train, verified.records)
    return said


def _frozen(folder: Path, trained_in: set[str]) -> Frozen:
    data = (folder / TASKS_FILE).read_bytes()
    records = Dataset.load(folder).records
    bases = tuple(sorted({_base(record) for record in records}))
    unseen = sum(_base(record) not in trained_in for record in records)
    return Frozen(len(records), unseen, bases, f"sha256:{hashlib.sha256(data).hexdigest()}")


def _check_apart(train: Sequence[TaskRecord], heldout: Sequence[TaskRecord]) -> None:
    """No goal signature on both sides, no room either, and at least half of what is held out in scenes of its own."""
    shared = {record.signature for record in train} & {record.signature for record in heldout}
    if shared:
        raise DatasetError(
            f"goals of the kind {min(shared)!r} are trained on and held out: give both one seed"
        )
    trained_in = {_base(record) for record in train}
    seen = sum(_base(record) in trained_in for record in heldout)
    if 2 * seen > len(heldout):
        raise DatasetError(
            f"{seen} of {len(heldout)} held-out tasks lie in scenes of training: expected at most half; the other scenes "
            "gave too few"
        )


def _base(record: TaskRecord) -> str:
    return record.task.scene_id.split("-")[0]
