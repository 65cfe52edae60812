"""The pipeline: base scenes, variants, written tasks, admission, data set. Deterministic for its settings, resumable."""

from __future__ import annotations

import contextlib
import dataclasses
import zlib
from collections import Counter, defaultdict
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.admission import Admitted, admit
from embomatrix.factory.pipeline.poses import Needs, cache_poses
from embomatrix.factory.pipeline.store import BuildStore, Rejection, VariantResult
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.social.writer import SocialWriter
from embomatrix.factory.writer.tasks import PlainWriter, is_heldout_signature
from embomatrix.factory.writer.variant import Variant, build_variant
from embomatrix.factory.writer.view import SceneView
from embomatrix.sim.executor import Simulator
from embomatrix.sim.physical.survey import Foresight
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.pose_cache import PlacementLibrary
from embomatrix.sim.prepared import prepare
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle, bundle_digest, encode_bundle
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import TaskRecord, write_dataset
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from embomatrix.factory.writer.tasks import Draft, TaskWriter
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.scene import Scene

DEFAULT_SCENES: Final = ("Rs_int", "Wainscott_0_int", "restaurant_diner")
TASKS_EACH: Final = 8
"""Tasks that one variant is to yield."""
DRAFTS: Final = 14
"""Drafts that are written for a variant: some are not admitted."""
WRITE_TRIES: Final = 120
"""Tasks that are written for the drafts: those of the other split's kinds are thrown away."""
FOCUS_ROOMS: Final = 3
"""Rooms that a variant furnishes with small things, and whose things its tasks are about."""
VARIANTS_FOR: Final = 4
"""Variants at most, for each one that would do if every draft were admitted."""


class WriterKind(StrEnum):
    """Where tasks come from."""

    PLAIN = "plain"  # what a goal says, in a bounded vocabulary: small policies learn from it
    SOCIAL = "social"  # what people come to ask for in conversations, each with its transcript
    MODEL = "model"  # the same with a language model in the place of the grammar


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """What decides a build: equal settings give equal data sets."""

    train: int = 480
    heldout: int = 40
    seed: int = 0
    scenes: tuple[str, ...] = DEFAULT_SCENES
    writer: WriterKind = WriterKind.PLAIN
    look_ahead: bool = True
    """Whether to find out what the arm can do in each variant: about 8 s of CPU for one."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What a build yielded. Counters by (split, category), (split, scene) and reason."""

    admitted: Mapping[tuple[str, str], int]
    scenes: Mapping[tuple[str, str], int]
    rejected: Mapping[str, int]
    variants: int
    rooms: Mapping[str, Mapping[str, tuple[str, ...]]]
    """Rooms by split and scene."""

    def total(self, split: str) -> int:
        return sum(count for (name, _), count in self.admitted.items() if name == split)


def split_rooms(scenes: Sequence[Scene], seed: int) -> dict[str, dict[str, tuple[str, ...]]]:
    """Held-out rooms, and those for training, by split and scene.

    Of each type of room, one in three is held out, at least one where there are two: every kind of room is on both
    sides. Which one turns with the seed and the type, so that they lie in several scenes.
    """
    by_type: defaultdict[str, list[tuple[str, str]]] = defaultdict(list)
    for scene in scenes:
        for room in scene.rooms:
            by_type[room.type].append((scene.base, room.name))
    heldout: set[tuple[str, str]] = set()
    for rank, (_, rooms) in enumerate(sorted(by_type.items())):
        if len(rooms) > 1:
            first = (rank + seed) % len(rooms)
            heldout |= {rooms[(first + step) % len(rooms)] for step in range(max(1, len(rooms) // 3))}
    return {
        split: {
            scene.base: tuple(
                room.name
                for room in scene.rooms
                if ((scene.base, room.name) in heldout) is (split == "heldout")
            )
            for scene in scenes
        }
        for split in ("train", "heldout")
    }


def build_dataset(
    folder: Path,
    settings: BuildSettings,
    progress: Callable[[str, int], None] = lambda _split, _admitted: None,
    writer: TaskWriter | None = None,
) -> Summary:
    """Write a data set, or go on with one that was cut short. ``progress`` hears of each split's admitted tasks.

    ``writer`` stands in for the one that the settings name; with a language model only it can be given.

    Raises CatalogError for an unknown scene, DatasetError when the folder holds a build of other settings.
    """
    for scene_id in settings.scenes:
        Catalog.load().inventory(scene_id)  # a wrong name shall leave no folder behind
    store = BuildStore.open(folder, dataclasses.asdict(settings))
    bases = [build_base_scene(scene_id, seed=settings.seed) for scene_id in settings.scenes]
    rooms = split_rooms(bases, settings.seed)
    if writer is None:
        writer = SocialWriter(settings.seed) if settings.writer is WriterKind.SOCIAL else PlainWriter()
    with contextlib.closing(PlacementLibrary()) as library:
        foresight = Foresight() if settings.look_ahead else None
        bench = _Workbench(settings, writer, library, foresight, progress)
        for split, target in (("heldout", settings.heldout), ("train", settings.train)):
            _fill_split(store, bases, rooms[split], split, target, bench)
    records = [record for result in store.results for record in result.records]
    write_dataset(folder, records, {})
    store.write_rejections()
    return _summary(store, rooms)


def _fill_split(
    store: BuildStore,
    bases: Sequence[Scene],
    rooms: Mapping[str, tuple[str, ...]],
    split: str,
    target: int,
    bench: _Workbench,
) -> None:
    """Variant after variant until the split has its tasks, the scenes taking turns."""
    settings = bench.settings
    quota = {category: _share(target, index) for index, category in enumerate(TaskCategory)}
    homes = [base for base in bases if _is_home(base, rooms[base.base])]
    for number in range(VARIANTS_FOR * (target // TASKS_EACH + 1)):
        done = Counter(record.task.category for record in store.records_of(split))
        bench.progress(split, done.total())
        missing = {category: quota[category] - done[category] for category in TaskCategory}
        if not homes or all(count <= 0 for count in missing.values()):
            break
        if store.has(split, number):
            continue
        base = homes[number % len(homes)]
        rng = np.random.default_rng(
            np.random.SeedSequence((settings.seed, zlib.crc32(split.encode()), number))
        )
        focus = _focus(base, rooms[base.base], missing, rng)
        variant = build_variant(base, focus, f"{base.base}-{split}-{number:03d}", rng)
        known = frozenset(
            f"{record.signature}|{record.task.instruction}" for record in store.records_of(split)
        )
        job = _VariantJob(variant, split, number, bench, known)
        result, data = job.run(missing, rng)
        store.add(result, data, job.transcripts())


def _is_home(base: Scene, rooms: Sequence[str]) -> bool:
    """Whether the rooms hold enough furniture to write tasks about: empty corridors and storage rooms do not."""
    view = SceneView(base)
    return (
        sum(view.is_surface(name) or view.is_container(name) for room in rooms for name in view.in_room[room])
        >= 3
    )


def _share(target: int, index: int) -> int:
    """Whole tasks of one category, the remainder going to the first ones."""
    kinds = len(TaskCategory)
    return target // kinds + (index < target % kinds)


def _focus(
    base: Scene, rooms: Sequence[str], missing: Mapping[TaskCategory, int], rng: np.random.Generator
) -> tuple[str, ...]:
    """Rooms of a variant: a kitchen while kitchen tasks are wanted, and others at random."""
    types = {room.name: room.type for room in base.rooms}
    order = [str(name) for name in rng.permutation(list(rooms))]
    wants_kitchen = missing[TaskCategory.KITCHEN_OPERATION] > 0
    order.sort(key=lambda name: not (wants_kitchen and types[name] in {"kitchen", "bar"}))
    return tuple(order[:FOCUS_ROOMS])


@dataclass(frozen=True)
class _Workbench:
    """What all variants of a build share."""

    settings: BuildSettings
    writer: TaskWriter
    library: PlacementLibrary
    foresight: Foresight | None
    progress: Callable[[str, int], None]


class _VariantJob:
    """Writes and judges the tasks of one variant."""

    def __init__(
        self,
        variant: Variant,
        split: str,
        number: int,
        bench: _Workbench,
        known: frozenset[str],
    ) -> None:
        self._variant = variant
        self._split = split
        self._number = number
        self._seed = bench.settings.seed
        self._writer = bench.writer
        self._library = bench.library
        self._foresight = bench.foresight
        self._known = set(known)
        self._view = SceneView(variant.scene)
        self._admitted: list[tuple[Draft, Plan]] = []
        self._rejections: list[Rejection] = []

    def run(
        self, missing: Mapping[TaskCategory, int], rng: np.random.Generator
    ) -> tuple[VariantResult, bytes]:
        """The variant's records with their bundle, the missing categories in turns."""
        drafts = self._write(missing, rng)
        needs = [Needs(draft.about, draft.task.table) for draft in drafts]
        poses = cache_poses(self._view, needs, self._library, self._foresight, self._seed)
        left = dict(missing)
        with contextlib.closing(Simulator(Bundle(self._variant.scene, {}, poses))) as stage:
            for draft in drafts:
                if len(self._admitted) == TASKS_EACH:
                    break
                if left[draft.task.category] > 0 and self._judge(stage, draft):
                    left[draft.task.category] -= 1
            tasks = {draft.task.task_id: draft.task for draft, _ in self._admitted}
            data = encode_bundle(prepare(Bundle(self._variant.scene, tasks, poses), stage.world))
        return self._result(bundle_digest(data)), data

    def _write(self, missing: Mapping[TaskCategory, int], rng: np.random.Generator) -> list[Draft]:
        """Drafts whose kinds of goal belong to this split, all different, the missing categories in turns."""
        wanted = [category for category, count in missing.items() if count > 0]
        drafts: list[Draft] = []
        for attempt in range(WRITE_TRIES):
            if len(drafts) == DRAFTS:
                break
            task_id = f"{self._variant.scene.scene_id}-{len(drafts):02d}"
            category = wanted[attempt % len(wanted)]
            draft = self._writer.write(self._variant, self._view, category, task_id, rng)
            if draft is not None and self._is_new(draft):
                drafts.append(draft)
                self._known.add(f"{draft.signature}|{draft.task.instruction}")
        return drafts

    def transcripts(self) -> dict[str, str]:
        """Of the admitted tasks that somebody talked about, by task id."""
        return {draft.task.task_id: draft.transcript for draft, _ in self._admitted if draft.transcript}

    def _is_new(self, draft: Draft) -> bool:
        """Whether the goal's kind belongs to this split, and nothing like it was asked for in these words."""
        key = f"{draft.signature}|{draft.task.instruction}"
        mine = is_heldout_signature(draft.signature, self._seed) is (self._split == "heldout")
        return mine and key not in self._known

    def _judge(self, stage: Simulator, draft: Draft) -> bool:
        verdict = admit(stage, draft.task, find_plan)
        if isinstance(verdict, Admitted):
            self._admitted.append((draft, verdict.plan))
            return True
        self._rejections.append(
            Rejection(
                scene=self._variant.scene.scene_id,
                category=draft.task.category.value,
                instruction=draft.task.instruction,
                goal=draft.task.goal_bddl,
                reason=verdict.reason,
                sentence=verdict.sentence,
            )
        )
        return False

    def _result(self, digest: str) -> VariantResult:
        records = tuple(
            TaskRecord(
                draft.task, digest, self._split, tuple(plan_to_json(plan)), draft.rooms, draft.signature
            )
            for draft, plan in self._admitted
        )
        return VariantResult(self._split, self._number, records, tuple(self._rejections))


def _summary(store: BuildStore, rooms: Mapping[str, Mapping[str, tuple[str, ...]]]) -> Summary:
    records = [record for result in store.results for record in result.records]
    rejections: Iterable[Rejection] = (item for result in store.results for item in result.rejections)
    return Summary(
        admitted=Counter((record.split, record.task.category.value) for record in records),
        scenes=Counter((record.split, record.task.scene_id.split("-")[0]) for record in records),
        rejected=Counter(item.reason.value for item in rejections),
        variants=len(store.results),
        rooms=rooms,
    )
