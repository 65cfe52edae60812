"""The pinned workload of `bench engine`: which plans are executed in which scenes, generated once and kept in a file.

Every plan has ten calls: two things are carried to other places and one door is opened, which makes five moves. All plans
of a file differ, and each of them ran to its end when the file was made.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.report.figures import BenchError
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import PlanError, parse_plan, plan_to_lines
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.records import Name, Record, SceneInvalidError, decode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.dataset import Dataset
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import Task

FORMAT: Final = 1
PINNED: Final = Path(__file__).parents[1] / "data" / "engine_workload.json"
CALLS: Final = 10
SIZES: Final = (60, 150, 300, 600)
"""Bodies of the scenes that cost is shown for. A scene counts for the size that it is nearest to, as a ratio."""
OTHER_SCENES: Final = 2
"""Scenes of each size but the main one."""
CHOICES: Final = 12
"""Things or places that are tried for one step of a plan."""
TRIES_PER_PLAN: Final = 8
UNDER_SHARE: Final = 0.1


class SceneWorkJson(Record):
    scene_id: Name
    bundle: Name
    bodies: int
    executions: list[str]


class WorkloadJson(Record):
    format: int
    seed: int
    bodies: int
    scenes: list[SceneWorkJson]


@dataclass(frozen=True, slots=True)
class Execution:
    """One rollout of the workload."""

    task_id: str
    seed: int
    plan: Plan


@dataclass(frozen=True, slots=True)
class SceneWork:
    """A scene, by the digest of its bundle, and what is executed in it."""

    scene_id: str
    bundle_digest: str
    bodies: int
    executions: tuple[Execution, ...]


@dataclass(frozen=True, slots=True)
class Workload:
    """``bodies`` is the main size: the figures are those of the scenes that are nearest to it."""

    seed: int
    bodies: int
    scenes: tuple[SceneWork, ...]

    @property
    def main(self) -> tuple[SceneWork, ...]:
        return self.of_size(self.bodies)

    def of_size(self, bodies: int) -> tuple[SceneWork, ...]:
        return tuple(scene for scene in self.scenes if size_of(scene.bodies) == bodies)


def size_of(bodies: int) -> int:
    """The one of ``SIZES`` that a scene is nearest to."""
    return min(SIZES, key=lambda size: abs(math.log(max(bodies, 1) / size)))


def write_workload(
    dataset: Dataset,
    *,
    seed: int,
    bodies: int,
    scenes: int,
    plans: int,
    on_scene: Callable[[str], None] = lambda _scene_id: None,
) -> Workload:
    """Plans for ``scenes`` scenes of the main size and a few of the others: equal datasets and seeds give equal ones.

    Raises BenchError when the dataset has too few scenes in which such plans can be carried out.
    """
    found: list[SceneWork] = []
    for size in SIZES:
        wanted = scenes if size == bodies else OTHER_SCENES
        for digest in _digests_of_size(dataset, size):
            if wanted == 0:
                break
            bundle = dataset.read_bundle(digest)
            on_scene(bundle.scene.scene_id)
            rng = np.random.default_rng(np.random.SeedSequence((seed, len(found))))
            executions = tuple(_executions(bundle, plans, rng))
            if len(executions) == plans:
                count = len(bundle.scene.objects)
                found.append(SceneWork(bundle.scene.scene_id, digest, count, executions))
                wanted -= 1
        if wanted and size == bodies:
            raise BenchError(
                f"the dataset in {dataset.folder} has {scenes - wanted} scenes of about {size} bodies in which {plans} plans "
                f"can be carried out: expected {scenes}; build one with more scenes, or ask for fewer"
            )
    return Workload(seed, bodies, tuple(found))


def workload_to_text(workload: Workload) -> str:
    """JSON with a line for each scene's head and each plan, so that a change can be read."""
    value = {
        "format": FORMAT,
        "seed": workload.seed,
        "bodies": workload.bodies,
        "scenes": [
            {
                "scene_id": scene.scene_id,
                "bundle": scene.bundle_digest,
                "bodies": scene.bodies,
                "executions": [
                    f"{item.task_id} {item.seed}: {'; '.join(plan_to_lines(item.plan).splitlines())}"
                    for item in scene.executions
                ],
            }
            for scene in workload.scenes
        ],
    }
    return json.dumps(value, indent=1) + "\n"


def read_workload(path: Path) -> Workload:
    """The workload in a file. Raises BenchError that names the file and the remedy."""
    try:
        record = decode(path.read_bytes(), WorkloadJson, "workload")
        if record.format != FORMAT:
            raise SceneInvalidError("workload.format", f"found {record.format}: this version reads {FORMAT}")
        return Workload(record.seed, record.bodies, tuple(map(_scene_work, record.scenes)))
    except (OSError, ValueError, RecursionError) as error:
        raise BenchError(
            f"the workload {path} can't be read ({error}): write it anew with 'embomatrix bench workload'"
        ) from error


def _scene_work(record: SceneWorkJson) -> SceneWork:
    executions = tuple(_execution(text, record.scene_id) for text in record.executions)
    return SceneWork(record.scene_id, record.bundle, record.bodies, executions)


def _execution(line: str, scene_id: str) -> Execution:
    path = f"workload, scene {scene_id}"
    head, _, text = line.partition(": ")
    task_id, _, seed = head.rpartition(" ")
    if not (task_id and seed.isdecimal()):
        raise SceneInvalidError(
            path, f"an execution begins with {head[:60]!r}: expected a task's id and a seed"
        )
    try:
        return Execution(task_id, int(seed), parse_plan(text))
    except PlanError as error:
        raise SceneInvalidError(path, str(error)) from error


def _digests_of_size(dataset: Dataset, size: int) -> list[str]:
    """Bundles whose scenes count for a size; different base scenes first, the nearest to the size before the others."""
    ranked: list[tuple[int, float, str]] = []
    seen: dict[str, int] = {}
    for digest in dict.fromkeys(record.bundle_digest for record in dataset.records):
        scene = dataset.read_bundle(digest).scene
        count = len(scene.objects)
        if size_of(count) == size:
            seen[scene.base] = seen.get(scene.base, 0) + 1
            ranked.append((seen[scene.base], abs(math.log(count / size)), digest))
    return [digest for _, _, digest in sorted(ranked)]


def _executions(bundle: Bundle, count: int, rng: np.random.Generator) -> Iterator[Execution]:
    """Up to ``count`` plans that differ, the tasks in turns; fewer when too many tries fail."""
    known: set[tuple[str, Plan]] = set()
    tasks = cycle([bundle.tasks[task_id] for task_id in sorted(bundle.tasks)])
    with contextlib.closing(load_simulator(bundle)) as stage:
        for _ in range(count * TRIES_PER_PLAN):
            if len(known) == count:
                return
            task = next(tasks)
            seed = int(rng.integers(2**31))
            plan = PlanWriter(stage, task, rng).write(seed)
            if plan is None or (task.task_id, plan) in known:
                continue
            trace = stage.execute(task, plan, seed)
            if trace.failure is None:
                known.add((task.task_id, plan))
                yield Execution(task.task_id, seed, plan)


class PlanWriter:
    """Writes one plan by trying its calls in the simulator: what is refused is chosen again."""

    def __init__(self, stage: Simulator, task: Task, rng: np.random.Generator) -> None:
        self._stage = stage
        self._task = task
        self._rng = rng
        scene: Scene = stage.world.scene
        rows = range(len(task.table))
        assets = [scene.asset_of(name) for name in task.table]
        self._things = [row for row in rows if not scene.by_name[task.table[row]].fixed]
        self._hosts = [row for row in rows if assets[row].supports or assets[row].interiors]
        self._doors = [row for row in rows if assets[row].joints]
        self._used: set[int] = set()
        self._opened: int | None = None

    def write(self, seed: int) -> Plan | None:
        """Two errands and a door in random order, or None when there is nothing to carry or to open."""
        self._stage.reset(self._task, seed)
        parts: list[Callable[[], Sequence[SkillCall] | None]] = [self._errand, self._errand, self._door]
        plan: list[SkillCall] = []
        for index in self._rng.permutation(len(parts)):
            calls = parts[index]()
            if calls is None:
                return None
            plan += calls
        return tuple(plan)

    def _errand(self) -> list[SkillCall] | None:
        """Carry a thing that was not carried before somewhere else: four calls."""
        for thing in self._shuffled(self._things):
            fetch = [SkillCall(Skill.MOVE, thing), SkillCall(Skill.PICK_UP, thing)]
            if thing in self._used or not self._runs(fetch):
                continue
            self._used.add(thing)
            for host in self._places():
                put = SkillCall(Skill.PLACE, host, relation=self._relation(host))
                bring = [SkillCall(Skill.MOVE, host), put]
                if host != thing and self._runs(bring):
                    return fetch + bring
            return None
        return None

    def _door(self) -> list[SkillCall] | None:
        for row in self._shuffled(self._doors):
            calls = [SkillCall(Skill.MOVE, row), SkillCall(Skill.OPEN, row)]
            if self._runs(calls):
                self._opened = row
                return calls
        return None

    def _places(self) -> Iterator[int]:
        """Where to put something: half of the time what was just opened, else any host."""
        if self._opened is not None and self._opened in self._hosts and self._rng.random() < 0.5:
            yield self._opened
        yield from self._shuffled(self._hosts)

    def _relation(self, host: int) -> PlaceRelation:
        asset = self._stage.world.asset(self._task.table[host])
        if host == self._opened and asset.interiors:
            return PlaceRelation.INSIDE
        if self._rng.random() < UNDER_SHARE:
            return PlaceRelation.UNDER
        return PlaceRelation.ONTOP if asset.supports else PlaceRelation.INSIDE

    def _runs(self, calls: Sequence[SkillCall]) -> bool:
        return all(self._stage.run_step(call).ok for call in calls)

    def _shuffled(self, rows: Sequence[int]) -> list[int]:
        return [rows[index] for index in self._rng.permutation(len(rows))[:CHOICES]]
