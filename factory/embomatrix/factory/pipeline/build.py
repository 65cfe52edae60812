"""The pipeline: base scenes, variants, written tasks, admission, data set. Deterministic for its settings, resumable.

Variants are made in rounds: all of a round know what the rounds before it yielded, and nothing of one another. So they can be
made in several processes, and the data set is the same however many there are.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.pipeline.store import BuildStore, Rejection
from embomatrix.factory.pipeline.variants import (
    TASKS_PER_VARIANT,
    VariantMaker,
    VariantOrder,
    VariantYield,
    uniqueness_key,
)
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.sim.process_pool import shared_work
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import DatasetError, write_dataset
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.layout.request import LayoutAgents
    from embomatrix.factory.pipeline.settings import BuildSettings
    from embomatrix.factory.writer.tasks import TaskWriter

    MakeVariants = Callable[[Sequence[VariantOrder]], Iterator[VariantYield]]
    """Makes variants; what comes of them comes in the order of the orders."""
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from embomatrix.world.dataset import TaskRecord
    from embomatrix.world.scene import Scene


VariantCheck = Callable[[VariantYield], VariantYield]
"""A second judge: leaves of a variant what is to be kept, and adds its refusals."""
ROUND_VARIANTS: Final = 6
"""Variants of a round, at most."""
MIN_FURNITURE: Final = 3
"""Pieces of furniture with a surface or a cavity that a scene's rooms must hold for tasks to be written about them."""
VARIANTS_PER_FULL: Final = 4
"""Variants at most, for each one that would do if every draft were admitted."""


@dataclass(frozen=True, slots=True)
class BuildSummary:
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
    sides. Which one turns with the seed and the type, so that they lie in several scenes; rooms without which a scene
    would have nothing left to train on come last.
    """
    by_type: defaultdict[str, list[tuple[str, str]]] = defaultdict(list)
    for scene in scenes:
        for room in scene.rooms:
            by_type[room.type].append((scene.base, room.name))
    spared = _HeldOutRooms(scenes)
    for rank, (_, rooms) in enumerate(sorted(by_type.items())):
        if len(rooms) > 1:
            first = (rank + seed) % len(rooms)
            spared.hold_out(rooms[first:] + rooms[:first], max(1, len(rooms) // 3))
    return {
        split: {
            scene.base: tuple(
                room.name
                for room in scene.rooms
                if ((scene.base, room.name) in spared.heldout) is (split == "heldout")
            )
            for scene in scenes
        }
        for split in ("train", "heldout")
    }


class _HeldOutRooms:
    """Rooms that are held out, and how much each scene keeps to train on."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self.heldout: set[tuple[str, str]] = set()
        self._worth = {scene.base: _usable_furniture(scene) for scene in scenes}
        self._left = {base: sum(worth.values()) for base, worth in self._worth.items()}

    def hold_out(self, rooms: Sequence[tuple[str, str]], count: int) -> None:
        """So many of the rooms, in their order; those that their scene needs only where no others are left."""
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
        """A scene that has too little anyhow loses nothing."""
        left, worth = self._left[base], self._worth[base][room]
        return left < MIN_FURNITURE or left - worth >= MIN_FURNITURE

    def _take(self, base: str, room: str) -> None:
        self.heldout.add((base, room))
        self._left[base] -= self._worth[base][room]


def _check_rooms(settings: BuildSettings) -> None:
    """Raises CatalogError for an unknown scene, DatasetError where tasks are to be held out and no room can be."""
    catalog = Catalog.load()
    types = Counter(room.type for scene_id in settings.scenes for room in catalog.inventory(scene_id).rooms)
    if settings.train and settings.heldout and max(types.values(), default=0) < 2:
        raise DatasetError(
            f"no room of {', '.join(settings.scenes)} can be held out, each is the only one of its type: give a further "
            "--scene, or --heldout 0"
        )


def _all_held_out(scenes: Sequence[Scene]) -> dict[str, dict[str, tuple[str, ...]]]:
    """Rooms by split and scene, where nothing is trained on: training sees none of them."""
    everything = {scene.base: tuple(room.name for room in scene.rooms) for scene in scenes}
    return {"train": dict.fromkeys(everything, ()), "heldout": everything}


def build_dataset(
    folder: Path,
    settings: BuildSettings,
    progress: Callable[[str, int], None] = lambda _split, _admitted: None,
    writer: TaskWriter | None = None,
    jobs: int = 1,
    check: VariantCheck | None = None,
    layout: LayoutAgents | None = None,
) -> BuildSummary:
    """Write a data set, or go on with one that was cut short. ``progress`` hears of each split's admitted tasks.

    ``check`` is a second judge, who leaves of each variant what is to be kept: a cluster, say.

    ``writer`` stands in for the one that the settings name, ``layout`` for layout agents that are rules, in this process;
    ``jobs`` is the number of processes otherwise.
    Raises CatalogError for an unknown scene, DatasetError when the scenes have no room to hold out, when the folder holds a
    build of other settings, or when a process dies.
    """
    _check_rooms(settings)  # before anything is written: what is wrong shall leave no folder behind
    store = BuildStore.open(folder, dataclasses.asdict(settings))
    began = time.process_time()
    bases = [build_base_scene(scene_id, seed=settings.seed) for scene_id in settings.scenes]
    store.spent_on_scenes(len(bases), time.process_time() - began)
    rooms = split_rooms(bases, settings.seed) if settings.train else _all_held_out(bases)
    with contextlib.ExitStack() as stack:
        make: MakeVariants | None = None
        for split, target in (("heldout", settings.heldout), ("train", settings.train)):
            filler = _SplitFiller(store, bases, rooms[split], split, target)
            while orders := filler.round():
                progress(split, filler.admitted)
                if make is None:
                    make = stack.enter_context(variant_makers(settings, writer, layout, jobs))
                for made in make(orders):
                    filler.take(made if check is None else check(made))
                    progress(split, filler.admitted)
            progress(split, filler.admitted)
    records = [record for result in store.results for record in result.records]
    write_dataset(folder, records, {})
    return _summary(store, rooms)


class _SplitFiller:
    """Variant after variant until a split has its tasks, the scenes taking turns."""

    def __init__(
        self,
        store: BuildStore,
        bases: Sequence[Scene],
        rooms: Mapping[str, tuple[str, ...]],
        split: str,
        target: int,
    ) -> None:
        self._store = store
        self._homes = [base.base for base in bases if _is_usable(base, rooms[base.base])]
        self._rooms = rooms
        self._split = split
        self._quota = {category: _share(target, index) for index, category in enumerate(TaskCategory)}
        self._end = VARIANTS_PER_FULL * (target // TASKS_PER_VARIANT + 1)
        self._number = 0

    @property
    def admitted(self) -> int:
        return len(self._store.records_of(self._split))

    def round(self) -> list[VariantOrder]:
        """The next variants to make, those left out that a build before this one made; none when the split is done.

        The first round that the store does not hold whole is made whole: its orders know of no variant of their own round.
        """
        while self._homes and self._number < self._end:
            missing = self._missing(self._number)
            if not any(missing.values()):
                break
            wanted = -(-sum(missing.values()) // TASKS_PER_VARIANT)
            numbers = range(self._number, min(self._number + min(ROUND_VARIANTS, wanted), self._end))
            known = self._known(self._number)
            self._number = numbers.stop
            orders = [
                VariantOrder(self._split, number, base, self._rooms[base], missing, known)
                for number in numbers
                if not self._store.has(self._split, number)
                for base in (self._homes[number % len(self._homes)],)
            ]
            if orders:
                return orders
        return []

    def take(self, made: VariantYield) -> None:
        """Keep what a variant yielded, but for what another of its round yielded too, or what is no longer wanted."""
        number = made.result.number
        left, known = self._missing(number), self._known(number)
        kept = []
        for record in made.result.records:
            if left[record.task.category] > 0 and _key(record) not in known:
                left[record.task.category] -= 1
                kept.append(record)
        names = {record.task.task_id for record in kept}
        transcripts = {name: text for name, text in made.transcripts.items() if name in names}
        trees = {name: tree for name, tree in made.trees.items() if name in names}
        self._store.add(
            dataclasses.replace(made.result, records=tuple(kept)), made.bundle, transcripts, trees, made.cpu_s
        )

    def _missing(self, before: int) -> dict[TaskCategory, int]:
        """How many tasks of each category the variants before this number leave to be made."""
        done = Counter(record.task.category for record in self._before(before))
        return {category: max(0, quota - done[category]) for category, quota in self._quota.items()}

    def _known(self, before: int) -> frozenset[str]:
        return frozenset(_key(record) for record in self._before(before))

    def _before(self, number: int) -> Iterator[TaskRecord]:
        for result in self._store.results:
            if result.split == self._split and result.number < number:
                yield from result.records


def _key(record: TaskRecord) -> str:
    return uniqueness_key(record.signature, record.task.instruction)


def _is_usable(base: Scene, rooms: Sequence[str]) -> bool:
    """Whether the rooms hold enough furniture to write tasks about: empty corridors and storage rooms do not."""
    worth = _usable_furniture(base)
    return sum(worth[room] for room in rooms) >= MIN_FURNITURE


def _usable_furniture(base: Scene) -> dict[str, int]:
    """Furniture to write tasks about, by room: what has a surface or holds things."""
    view = SceneView(base)
    return {
        room.name: sum(view.is_surface(name) or view.is_container(name) for name in view.in_room[room.name])
        for room in base.rooms
    }


def _share(target: int, index: int) -> int:
    """Whole tasks of one category, the remainder going to the first ones."""
    kinds = len(TaskCategory)
    return target // kinds + (index < target % kinds)


def _summary(store: BuildStore, rooms: Mapping[str, Mapping[str, tuple[str, ...]]]) -> BuildSummary:
    records = [record for result in store.results for record in result.records]
    rejections: Iterable[Rejection] = (item for result in store.results for item in result.rejections)
    return BuildSummary(
        admitted=Counter((record.split, record.task.category.value) for record in records),
        scenes=Counter((record.split, record.task.scene_id.split("-")[0]) for record in records),
        rejected=Counter(item.reason.value for item in rejections),
        variants=len(store.results),
        rooms=rooms,
    )


@contextlib.contextmanager
def variant_makers(
    settings: BuildSettings, writer: TaskWriter | None, layout: LayoutAgents | None, jobs: int
) -> Iterator[MakeVariants]:
    """For as long as this is held. ``writer`` and ``layout`` work in this process alone: they may hold a connection."""
    if writer is not None or layout is not None:
        with contextlib.closing(VariantMaker(settings, writer, layout)) as maker:
            yield lambda orders: map(maker.make, orders)
        return
    died = DatasetError(
        "a process that makes scene variants died, perhaps for want of memory: what was built is kept; call the same "
        "command again, with fewer --jobs"
    )
    with shared_work(jobs, VariantMaker, VariantMaker.make, settings, died=died) as make:
        yield make
