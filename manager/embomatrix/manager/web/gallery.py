"""Tasks of a dataset for the dashboard. The dataset is only read, and may be written after the manager started.

Names in a dataset are untrusted. Only plain names become paths, links must stay within the folder, and file sizes are
limited.
"""

import asyncio
import functools
import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from embomatrix.manager.web.floor_plan import floor_plan, moments_of, movable_objects
from embomatrix.manager.web.gallery_values import (
    FloorPlanView,
    MomentView,
    ObjectRow,
    SceneCount,
    SceneName,
    TaskCard,
    TaskDetail,
    TaskPage,
)
from embomatrix.rpc.status import NotFoundError, UnavailableError
from embomatrix.rpc.wire.training import SampledStep
from embomatrix.skills.parse import PlanError, parse_plan, plan_from_json
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, TaskRecord
from embomatrix.world.evaluate import GoalError
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene
from embomatrix.world.whole_file import read_whole

TASKS_BYTES: Final = 256_000_000
"""Size limit of ``tasks.jsonl``, about 60,000 tasks."""
NOTE_BYTES: Final = 262_144
"""Size limit of a transcript or a layout tree."""
PICTURE_BYTES: Final = 2_000_000
PLANS_KEPT: Final = 64
"""Floor plans in memory, of less than 1 MB each."""
PICTURES_FOLDER: Final = "pictures"
HANGS_M: Final = 0.05
"""An object above this height without support hangs on a wall."""
_PLAIN: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
_JPEG: Final = b"\xff\xd8\xff"


def no_tasks_yet(folder: Path) -> str:
    """Return the sentence for a dataset's folder that holds no tasks."""
    return (
        f"{folder} holds no tasks yet: the dashboard shows them once {TASKS_FILE} is there; "
        f"`embomatrix factory starter --out={folder}` writes the shipped ones"
    )


class Gallery:
    """Tasks of the dataset in ``folder``. Reads run in a thread, one at a time.

    A folder without ``tasks.jsonl`` has no tasks until the file appears. A changed file is read again.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._reading = asyncio.Lock()
        self._stamp: tuple[int, int] | None = None
        self._records: dict[str, TaskRecord] = {}
        self._scenes: dict[str, str] = {}
        """Scene of each bundle, in the order of the tasks."""
        self._dataset: Dataset  # set with the stamp
        self._held: tuple[str, Scene] | None = None
        """Scene that was read last, by its digest. A hostile one takes 100 MB, so there is only one."""
        self._floor = functools.lru_cache(PLANS_KEPT)(lambda digest: floor_plan(self._scene(digest)))

    async def page(self, *, search: str, scene: str, category: str, offset: int, limit: int) -> TaskPage:
        """Return a page of the tasks with these words in their instruction or id, in file order. Raises
        UnavailableError.
        """
        async with self._reading:
            return await asyncio.to_thread(self._page, search, scene, category, offset, limit)

    def _page(self, search: str, scene: str, category: str, offset: int, limit: int) -> TaskPage:
        records = list(self._load().values())
        words = search.lower().split()
        found = [
            record
            for record in records
            if scene in ("", record.task.scene_id)
            and category in ("", record.task.category.value)
            and all(word in f"{record.task.instruction} {record.task.task_id}".lower() for word in words)
        ]
        scenes = Counter(record.task.scene_id for record in records)
        return TaskPage(
            len(found),
            offset,
            [self._card(record) for record in found[offset : offset + limit]],
            [SceneCount(name, number) for name, number in sorted(scenes.items())],
            sorted({record.task.category.value for record in records}),
            "" if records else no_tasks_yet(self._folder),
        )

    async def scenes(self, *, offset: int, limit: int) -> list[SceneName]:
        """Return the scene of each bundle, in the order of the tasks. Raises UnavailableError."""
        await self._loaded()
        return [SceneName(*pair) for pair in itertools.islice(self._scenes.items(), offset, offset + limit)]

    async def detail(self, task_id: str, steps: Sequence[SampledStep] | None = None) -> TaskDetail:
        """Return one task, with the moments of the steps if they are given, else with those of the oracle's plan.

        Raises NotFoundError, or UnavailableError for a damaged dataset.
        """
        record = (await self._loaded()).get(task_id)
        if record is None:
            raise NotFoundError(f"the dataset has no task {task_id[:100]!r}: the page of tasks lists them")
        async with self._reading:
            return await asyncio.to_thread(self._read_detail, record, steps)

    async def floor(self, digest: str) -> FloorPlanView:
        """Return the floor plan of a bundle's scene. Raises NotFoundError."""
        await self._check_bundle(digest)
        async with self._reading:
            return await asyncio.to_thread(self._floor, digest)

    async def picture(self, digest: str) -> bytes:
        """Return the JPEG of a bundle's scene that ``embomatrix factory pictures`` made. Raises NotFoundError."""
        await self._check_bundle(digest)
        name = f"{digest.removeprefix('sha256:')}.jpg"
        async with self._reading:
            data = await asyncio.to_thread(self._file, PICTURES_FOLDER, name, PICTURE_BYTES)
        if not data.startswith(_JPEG):
            raise NotFoundError(
                f"there is no picture of scene {digest}: `embomatrix factory pictures` makes them"
            )
        return data

    async def _check_bundle(self, digest: str) -> None:
        await self._loaded()
        if digest not in self._scenes:
            raise NotFoundError(f"no task of the dataset is in a bundle {digest[:80]!r}")

    async def _loaded(self) -> dict[str, TaskRecord]:
        """Return the records by id. They are read again after the file changes."""
        async with self._reading:
            return await asyncio.to_thread(self._load)

    def _load(self) -> dict[str, TaskRecord]:
        file = self._folder / TASKS_FILE
        try:
            known = file.stat()
            if known.st_size > TASKS_BYTES:
                raise UnavailableError(
                    f"{file} has {known.st_size} bytes: at most {TASKS_BYTES} are shown, name a smaller dataset"
                )
            if self._stamp != (known.st_mtime_ns, known.st_size):
                dataset = Dataset.load(self._folder)
                self._dataset, self._stamp = dataset, (known.st_mtime_ns, known.st_size)
                self._records = {record.task.task_id: record for record in dataset.records}
                self._scenes = {record.bundle_digest: record.task.scene_id for record in dataset.records}
                self._held = None
                self._floor.cache_clear()
        except OSError as error:
            if isinstance(error, FileNotFoundError) and self._folder.is_dir():
                self._stamp, self._records, self._scenes = None, {}, {}
                return self._records
            raise UnavailableError(
                f"the dataset {self._folder} can't be read ({error.strerror}): start the manager with another --dataset"
            ) from error
        except DatasetError as error:
            raise UnavailableError(str(error)) from error
        return self._records

    def _scene(self, digest: str) -> Scene:
        if self._held is not None and self._held[0] == digest:
            return self._held[1]
        self._held = None  # frees its memory for the next one
        try:
            scene = self._dataset.read_bundle(digest).scene
        except DatasetError as error:
            raise UnavailableError(str(error)) from error
        self._held = (digest, scene)
        return scene

    def _read_detail(self, record: TaskRecord, steps: Sequence[SampledStep] | None) -> TaskDetail:
        task, scene = record.task, self._scene(record.bundle_digest)
        about: frozenset[str] = frozenset()
        problem, moments = "", [*moments_of(scene, task, ())]
        try:
            about = task.goal_objects
            if steps is None:
                moments = moments_of(scene, task, plan_from_json(list(record.oracle), task.profile))
            elif steps:
                plan = parse_plan("\n".join(step.call for step in steps), task.profile)
                failed = {place for place, step in enumerate(steps) if not step.ok}
                moments = moments_of(scene, task, plan, failed)
        except (GoalError, PlanError) as error:
            problem = str(error)
        tree = self._note("trees", task.task_id, "json")
        return TaskDetail(
            card=self._card(record),
            goal=task.goal_bddl,
            source=task.source,
            profile=task.profile.value,
            signature=record.signature,
            rooms=_rooms(scene, record, moments),
            objects=[_row(scene, name, about) for name in task.table if name in scene.by_name],
            transcript=self._note("transcripts", task.task_id, "md"),
            tree=_parsed(tree),
            floor=self._floor(record.bundle_digest),
            things=movable_objects(scene, task),
            moments=moments,
            problem=problem,
        )

    def _card(self, record: TaskRecord) -> TaskCard:
        task, hexdigits = record.task, record.bundle_digest.removeprefix("sha256:")
        return TaskCard(
            task.task_id,
            task.instruction,
            task.category.value,
            task.scene_id,
            record.split,
            len(record.oracle),
            len(task.table),
            record.bundle_digest,
            self._path(PICTURES_FOLDER, f"{hexdigits}.jpg") is not None,
        )

    def _note(self, folder: str, task_id: str, ending: str) -> str:
        return self._file(folder, f"{task_id}.{ending}", NOTE_BYTES).decode("utf-8", "replace")

    def _file(self, folder: str, name: str, at_most: int) -> bytes:
        """Return the content of an optional file; empty if it is absent or too large."""
        path = self._path(folder, name)
        try:
            return b"" if path is None else read_whole(path, at_most=at_most)
        except OSError:
            return b""

    def _path(self, folder: str, name: str) -> Path | None:
        """Return the path of an existing file with a plain name inside the dataset; None otherwise."""
        if not _PLAIN.fullmatch(name):
            return None
        path = self._folder / folder / name
        inside = path.is_file() and path.resolve().is_relative_to(self._folder.resolve())
        return path if inside else None


def _row(scene: Scene, name: str, about: frozenset[str]) -> ObjectRow:
    item, asset = scene.by_name[name], scene.asset_of(name)
    state_words = sorted(state.value for state in item.states)
    state_words += ["open"] if any(share > 0 for share in item.joints) else []
    size = [round(extent, 2) for extent in asset.size_m]
    return ObjectRow(
        name,
        item.room,
        _where(scene, name),
        size,
        float(f"{asset.mass_kg:.3g}"),
        ", ".join(state_words),
        name in about,
    )


def _where(scene: Scene, name: str) -> str:
    """Return the support of the object: its host, the wall, or the floor."""
    item = scene.by_name[name]
    if item.host and item.relation:
        return f"{item.relation.value} {item.host}"
    return "on the wall" if scene.box_of(name).low_m[2] > HANGS_M else "on the floor"


def _rooms(scene: Scene, record: TaskRecord, moments: list[MomentView]) -> list[str]:
    """Return the rooms of the table's objects, and those that the robot visits."""
    table = {scene.by_name[name].room for name in record.task.table if name in scene.by_name}
    visited = {scene.room_at((moment.robot[0], moment.robot[1])) for moment in moments}
    return sorted((table | visited) - {""})


def _parsed(text: str) -> object:
    """Return a parsed layout tree; None if there is none, or for invalid JSON."""
    try:
        return parse_json(text) if text else None
    except ValueError:
        return None
