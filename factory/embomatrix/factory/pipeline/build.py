"""Build of a dataset: base scenes, variants, written tasks, admission. Builds are deterministic and resumable.

Variants are made in rounds. The variants of a round know the tasks of earlier rounds but not those of their own
round. Therefore the dataset does not depend on the number of processes.
"""

import dataclasses
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol

from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.pipeline.store import BUILD_FILE, BuildStore, Rejection, VariantYield
from embomatrix.factory.pipeline.variants import TASKS_PER_VARIANT, VariantMaker, VariantOrder, uniqueness_key
from embomatrix.factory.scenes.base_scenes import BaseScenes, check_kept, keep_scenes
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.household import place_of
from embomatrix.factory.writer.tasks import TaskWriter
from embomatrix.sim.process_pool import shared_work
from embomatrix.world.dataset import TASKS_FILE, DatasetError, TaskRecord, write_dataset
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

VariantCheck = Callable[[VariantYield], VariantYield]
"""Second check of a variant: removes tasks and adds their rejections."""
ROUND_VARIANTS: Final = 6
"""Maximum number of variants in a round."""
MIN_FURNITURE: Final = 3
"""Minimum number of furniture pieces with a surface or cavity in a scene's rooms. Scenes with fewer get no tasks."""
VARIANTS_PER_FULL: Final = 4
"""Maximum number of variants, as a multiple of the number needed if every draft were admitted."""


@dataclass(frozen=True, slots=True)
class BuildSummary:
    """Result of a build, with counters by (split, category), by (split, scene) and by reason."""

    admitted: Mapping[tuple[str, str], int]
    scenes: Mapping[tuple[str, str], int]
    rejected: Mapping[str, int]
    variants: int
    rooms: Mapping[str, Mapping[str, tuple[str, ...]]]
    """Room names by split and scene."""

    def total(self, split: str) -> int:
        return sum(count for (name, _), count in self.admitted.items() if name == split)


def split_rooms(scenes: Sequence[Scene], seed: int) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the rooms of the held-out split and of the training split, by scene.

    One in three rooms of each type is held out, at least one if there are two, so both splits contain every type. The
    choice rotates with seed and type, so that held-out rooms lie in several scenes. Rooms that a scene needs for
    training are held out last.
    """
    by_type: defaultdict[str, list[tuple[str, str]]] = defaultdict(list)
    for scene in scenes:
        for room in scene.rooms:
            by_type[room.type].append((scene.base, room.name))
    held_out_rooms = _HeldOutRooms(scenes)
    for rank, (_, rooms) in enumerate(sorted(by_type.items())):
        if len(rooms) > 1:
            first = (rank + seed) % len(rooms)
            held_out_rooms.hold_out(rooms[first:] + rooms[:first], max(1, len(rooms) // 3))
    return {
        split: {
            scene.base: tuple(
                room.name
                for room in scene.rooms
                if ((scene.base, room.name) in held_out_rooms.heldout) is (split == "heldout")
            )
            for scene in scenes
        }
        for split in ("train", "heldout")
    }


class _HeldOutRooms:
    """Held-out rooms, and the furniture that remains for training in each scene."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self.heldout: set[tuple[str, str]] = set()
        self._worth = {scene.base: _usable_furniture(scene) for scene in scenes}
        self._left = {base: sum(worth.values()) for base, worth in self._worth.items()}

    def hold_out(self, rooms: Sequence[tuple[str, str]], count: int) -> None:
        """Hold out ``count`` of the rooms in order. Rooms that their scene needs are used only if no others are left."""
        kept: list[tuple[str, str]] = []
        wanted = count
        for room in rooms:
            if wanted and self._can_go(*room):
                self._take(*room)
                wanted -= 1
            else:
                kept.append(room)
        for room in kept[:wanted]:
            self._take(*room)

    def _can_go(self, base: str, room: str) -> bool:
        """True if the scene keeps enough furniture, or has too little anyway."""
        left, worth = self._left[base], self._worth[base][room]
        return left < MIN_FURNITURE or left - worth >= MIN_FURNITURE

    def _take(self, base: str, room: str) -> None:
        self.heldout.add((base, room))
        self._left[base] -= self._worth[base][room]


def _check_rooms(settings: BuildSettings, scenes: BaseScenes) -> None:
    """Raise CatalogError for an unknown scene, or DatasetError if tasks are held out but no room can be."""
    types = Counter(scenes.room_types())
    if settings.train and settings.heldout and max(types.values(), default=0) < 2:
        raise DatasetError(
            f"no room of {', '.join(settings.scenes)} can be held out, each is the only one of its type: add another "
            "--scene, or give --heldout 0"
        )


class Maker(Protocol):
    """Maker of variants: small objects and tasks about them, or a day with its needs."""

    def make(self, order: VariantOrder) -> VariantYield:
        """Return the variant of an order. It depends only on the settings and the order."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Making:
    """Way in which variants are made. ``begin`` starts a maker from the settings, in each process of the build. Scenes of
    files are its argument ``own``.

    If ``whole_scenes``, the held-out tasks lie in scenes of their own, otherwise in rooms of their own. ``tasks`` is the
    number of tasks that a variant should yield. ``most`` is the largest share of a category; None makes
    all categories equal. ``alike`` is the largest number of tasks with one kind of goal in a base scene; None sets no limit.
    """

    begin: Callable[..., Maker]
    whole_scenes: bool = False
    tasks: int = TASKS_PER_VARIANT
    most: float | None = None
    alike: int | None = None


def _make(maker: Maker, order: VariantOrder) -> VariantYield:
    return maker.make(order)


HELD_OUT_SCENES: Final = 5
"""One in this many scenes of a kind of place is held out, if the held-out tasks have scenes of their own."""


def split_scenes(scenes: Sequence[Scene], seed: int) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return all rooms of the held-out scenes, and all rooms of the others, by split and scene.

    One in five scenes of each kind of place is held out, but at least one scene if there are two. A single scene is in both
    splits: its held-out tasks differ in needs, words and goal shapes.
    """
    by_place: defaultdict[str, list[str]] = defaultdict(list)
    for scene in scenes:
        by_place[place_of(scene.base)].append(scene.base)
    heldout = {
        base
        for names in by_place.values()
        for rank, base in enumerate(sorted(names))
        if rank % HELD_OUT_SCENES == seed % HELD_OUT_SCENES and len(names) >= HELD_OUT_SCENES
    }
    if not heldout and len(scenes) > 1:
        heldout = {sorted(scene.base for scene in scenes)[seed % len(scenes)]}
    both = len(scenes) == 1
    rooms = {scene.base: tuple(room.name for room in scene.rooms) for scene in scenes}
    return {
        "train": {base: names if both or base not in heldout else () for base, names in rooms.items()},
        "heldout": {base: names if both or base in heldout else () for base, names in rooms.items()},
    }


def _rooms_by_split(
    scenes: Sequence[Scene], settings: BuildSettings, *, whole_scenes: bool
) -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the rooms of both splits. A build of one split has all rooms for it."""
    everything = {scene.base: tuple(room.name for room in scene.rooms) for scene in scenes}
    nothing: dict[str, tuple[str, ...]] = dict.fromkeys(everything, ())
    if not settings.train:
        return {"train": nothing, "heldout": everything}
    if not settings.heldout:
        return {"train": everything, "heldout": nothing}
    return split_scenes(scenes, settings.seed) if whole_scenes else split_rooms(scenes, settings.seed)


def build_dataset(
    folder: Path,
    settings: BuildSettings,
    progress: Callable[[str, int], None] = lambda _split, _admitted: None,
    writer: TaskWriter | None = None,
    jobs: int = 1,
    check: VariantCheck | None = None,
    layout: LayoutAgents | None = None,
    making: Making | None = None,
    own: Mapping[str, Scene] = MappingProxyType({}),
) -> BuildSummary:
    """Build a dataset, or resume an interrupted build. ``progress`` is called with each split's number of admitted tasks.

    ``making`` replaces the maker of variants. ``own`` are scenes of files by their names in the settings; the folder keeps
    them.

    ``check`` is a second check of each variant, such as a cluster. ``writer`` and ``layout`` replace the writer of
    the settings and the rule-based layout agents; they run in this process. Otherwise ``jobs`` processes are used.

    Raise CatalogError for an unknown scene. Raise DatasetError if no room can be held out, if the folder holds a
    build with other settings, or if a process dies. Raise OSError if the folder can't be written.
    """
    whole_scenes = making is not None and making.whole_scenes
    scenes = BaseScenes(settings.scenes, own)
    if not whole_scenes:
        _check_rooms(
            settings, scenes
        )  # checked before anything is written, so that an error leaves no folder behind
    store = _store_in(folder, settings, list(own.values()))
    began = time.process_time()
    bases = scenes.built_all(seed=settings.seed)
    store.spend({"base_scenes": len(bases)}, time.process_time() - began)
    rooms = _rooms_by_split(bases, settings, whole_scenes=whole_scenes)
    died = DatasetError(
        "a process that makes scene variants died, possibly for lack of memory: finished variants are kept; run the "
        "same command again with fewer --jobs"
    )
    here = writer is not None or layout is not None
    if making is None:
        making = Making(VariantMaker)
        begin_with: tuple[object, ...] = (settings, writer, layout)
    else:
        begin_with = (settings,)
    begin = partial(making.begin, own=dict(own)) if own else making.begin
    with shared_work(1 if here else jobs, begin, _make, *begin_with, died=died) as make:
        for split, target in (("heldout", settings.heldout), ("train", settings.train)):
            orders = _SplitOrders(store, bases, rooms[split], split, target, making)
            while round_orders := orders.next_round():
                progress(split, orders.admitted)
                for variant in make(round_orders):
                    orders.add(variant if check is None else check(variant))
                    progress(split, orders.admitted)
            progress(split, orders.admitted)
    records = [record for result in store.results for record in result.records]
    write_dataset(folder, records, {})
    return _summary(store, rooms)


def _store_in(folder: Path, settings: BuildSettings, own: Sequence[Scene]) -> BuildStore:
    """Start or resume a build. The scenes of files are written before it starts, and compared when it is resumed."""
    if not (folder / BUILD_FILE).exists():
        if (folder / TASKS_FILE).exists():
            raise DatasetError(
                f"{folder} holds a dataset that no build wrote: name another folder with --out, or remove this one"
            )
        keep_scenes(folder, own)
    store = BuildStore(folder, dataclasses.asdict(settings))
    check_kept(folder, own)
    return store


class _SplitOrders:
    """Orders of variants for one split until it has its tasks. The scenes take turns."""

    def __init__(
        self,
        store: BuildStore,
        bases: Sequence[Scene],
        rooms: Mapping[str, tuple[str, ...]],
        split: str,
        target: int,
        making: Making,
    ) -> None:
        self._store = store
        self._target = target
        self._tasks = making.tasks
        self._usable = [base.base for base in bases if _is_usable(base, rooms[base.base])]
        self._rooms = rooms
        self._split = split
        self._quota = {
            category: _share(target, index) if making.most is None else math.ceil(target * making.most)
            for index, category in enumerate(TaskCategory)
        }
        self._most_alike = making.alike
        self._end = VARIANTS_PER_FULL * (target // making.tasks + 1)
        self._number = 0

    @property
    def admitted(self) -> int:
        return sum(1 for _ in self._before(self._end))

    def next_round(self) -> list[VariantOrder]:
        """Return the next variants to make, without those that the store already holds. Empty if the split is complete.

        An incomplete round is repeated with the orders of its first start, which know no task of their own round.
        """
        while self._usable and self._number < self._end:
            missing = self._missing(self._number)
            if not any(missing.values()):
                break
            wanted = -(-min(sum(missing.values()), self._left(self._number)) // self._tasks)
            numbers = range(self._number, min(self._number + min(ROUND_VARIANTS, wanted), self._end))
            known = self._known(self._number)
            self._number = numbers.stop
            made = {result.number for result in self._store.results if result.split == self._split}
            orders = [
                VariantOrder(
                    self._split,
                    number,
                    base,
                    self._rooms[base],
                    missing,
                    known,
                    self._alike(base, number),
                    self._told(base, numbers.start),
                )
                for number in numbers
                if number not in made
                for base in (self._usable[number % len(self._usable)],)
            ]
            if orders:
                return orders
        return []

    def add(self, variant: VariantYield) -> None:
        """Store a variant's result without duplicates of its round and without surplus tasks."""
        number = variant.result.number
        left, known = self._missing(number), self._known(number)
        most = self._left(number)
        kept: list[TaskRecord] = []
        alike = self._alike(self._usable[number % len(self._usable)], number)
        for record in variant.result.records:
            is_common = self._most_alike is not None and alike[record.signature] >= self._most_alike
            if (
                len(kept) < most
                and left[record.task.category] > 0
                and _key(record) not in known
                and not is_common
            ):
                left[record.task.category] -= 1
                alike[record.signature] += 1
                kept.append(record)
        names = {record.task.task_id for record in kept}
        kept_variant = dataclasses.replace(
            variant,
            result=dataclasses.replace(variant.result, records=tuple(kept)),
            transcripts={name: text for name, text in variant.transcripts.items() if name in names},
            trees={name: tree for name, tree in variant.trees.items() if name in names},
        )
        self._store.add(kept_variant)

    def _missing(self, before: int) -> dict[TaskCategory, int]:
        """Return the number of tasks of each category that may be added before this variant."""
        done = Counter(record.task.category for record in self._before(before))
        left = self._left(before)
        return {
            category: min(left, max(0, quota - done[category])) for category, quota in self._quota.items()
        }

    def _left(self, before: int) -> int:
        """Return the number of tasks that are missing before this variant."""
        return max(0, self._target - sum(1 for _ in self._before(before)))

    def _known(self, before: int) -> frozenset[str]:
        return frozenset(_key(record) for record in self._before(before))

    def _alike(self, base: str, before: int) -> Counter[str]:
        """Return the number of tasks of a base scene before this variant, by kind of goal."""
        records = self._before(before) if self._most_alike is not None else ()
        return Counter(record.signature for record in records if base_scene_of(record.task.scene_id) == base)

    def _told(self, base: str, before: int) -> tuple[str, ...]:
        """Return the instructions of a base scene's tasks before this variant."""
        return tuple(
            record.task.instruction
            for record in self._before(before)
            if base_scene_of(record.task.scene_id) == base
        )

    def _before(self, number: int) -> Iterator[TaskRecord]:
        for result in self._store.results:
            if result.split == self._split and result.number < number:
                yield from result.records


def _key(record: TaskRecord) -> str:
    return uniqueness_key(record.signature, record.task.instruction)


def _is_usable(base: Scene, rooms: Sequence[str]) -> bool:
    """True if the rooms hold enough furniture for tasks. Empty corridors and storage rooms don't."""
    worth = _usable_furniture(base)
    return sum(worth[room] for room in rooms) >= MIN_FURNITURE


def _usable_furniture(base: Scene) -> dict[str, int]:
    """Return the number of furniture pieces with a surface or cavity, by room."""
    view = SceneView(base)
    return {
        room.name: sum(view.is_surface(name) or view.is_container(name) for name in view.in_room[room.name])
        for room in base.rooms
    }


def _share(target: int, index: int) -> int:
    """Return the quota of one category. The remainder goes to the first categories."""
    kinds = len(TaskCategory)
    return target // kinds + (index < target % kinds)


def _summary(store: BuildStore, rooms: Mapping[str, Mapping[str, tuple[str, ...]]]) -> BuildSummary:
    records = [record for result in store.results for record in result.records]
    rejections: Iterable[Rejection] = (item for result in store.results for item in result.rejections)
    return BuildSummary(
        admitted=Counter((record.split, record.task.category.value) for record in records),
        scenes=Counter((record.split, base_scene_of(record.task.scene_id)) for record in records),
        rejected=Counter(item.reason.value for item in rejections),
        variants=len(store.results),
        rooms=rooms,
    )
