"""Writer of workloads: it draws ten-call plans at random and keeps those that the simulator executes to their end.

A plan carries two objects to other places and opens one door, which makes five moves. All plans of a workload differ.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.bench.engine.workload import (
    SIZES,
    WORKLOAD_FILE,
    Execution,
    SceneWork,
    Workload,
    nearest_size,
    workload_to_text,
)
from embomatrix.bench.report.figures import BenchError
from embomatrix.sim.executor import Simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset, write_dataset
from embomatrix.world.task import Task
from embomatrix.world.whole_file import write_whole

OTHER_SCENES: Final = 1
"""Scenes of each size but the main one."""
CANDIDATES: Final = 12
"""Objects or places tried for one step of a plan."""
TRIES_PER_PLAN: Final = 8
UNDER_SHARE: Final = 0.1


def write_workload(
    dataset: Dataset, *, seed: int, bodies: int, scenes: int, plans: int, on_scene: Callable[[str], None]
) -> Workload:
    """Write plans for ``scenes`` scenes of the main size and one of each other size.

    Equal datasets and arguments give equal workloads. Raises BenchError if too few scenes allow that many plans.
    """
    found: list[SceneWork] = []
    for size in SIZES:
        missing = scenes if size == bodies else OTHER_SCENES
        for digest in _digests_of_size(dataset, size):
            if missing == 0:
                break
            bundle = dataset.read_bundle(digest)
            on_scene(bundle.scene.scene_id)
            rng = np.random.default_rng(np.random.SeedSequence((seed, len(found))))
            executions = tuple(_executions(bundle, plans, rng))
            if len(executions) == plans:
                found.append(SceneWork(bundle.scene.scene_id, digest, len(bundle.scene.objects), executions))
                missing -= 1
        if missing and size == bodies:
            raise BenchError(
                f"the dataset in {dataset.folder} has {scenes - missing} scenes of about {size} bodies that allow "
                f"{plans} plans: expected {scenes}; build one with more scenes, or ask for fewer"
            )
    return Workload(seed, bodies, tuple(found))


def save_workload(dataset: Dataset, workload: Workload, folder: Path) -> None:
    """Write the workload into a folder; a folder that is not the dataset's gets the tasks and bundles it needs."""
    digests = {scene.bundle_digest for scene in workload.scenes}
    if folder.resolve() != dataset.folder.resolve():
        records = [record for record in dataset.records if record.bundle_digest in digests]
        write_dataset(folder, records, {digest: dataset.bundle_bytes(digest) for digest in digests})
    write_whole(folder / WORKLOAD_FILE, workload_to_text(workload).encode("utf-8"))


def _digests_of_size(dataset: Dataset, size: int) -> list[str]:
    """Bundles of one size: a bundle of every base scene first, then second ones; within that the nearest to the size."""
    ranked: list[tuple[int, float, str]] = []
    seen: dict[str, int] = {}
    for digest in dict.fromkeys(record.bundle_digest for record in dataset.records):
        scene = dataset.read_bundle(digest).scene
        count = len(scene.objects)
        if nearest_size(count) == size:
            seen[scene.base] = seen.get(scene.base, 0) + 1
            ranked.append((seen[scene.base], abs(math.log(count / size)), digest))
    return [digest for _, _, digest in sorted(ranked)]


def _executions(bundle: Bundle, count: int, rng: np.random.Generator) -> Iterator[Execution]:
    """Yield up to ``count`` different plans, the tasks in turn; fewer if too many tries fail."""
    known: set[tuple[str, Plan]] = set()
    tasks = cycle([bundle.tasks[task_id] for task_id in sorted(bundle.tasks)])
    with contextlib.closing(load_simulator(bundle)) as simulator:
        for _ in range(count * TRIES_PER_PLAN):
            if len(known) == count:
                return
            task = next(tasks)
            seed = int(rng.integers(2**31))
            plan = PlanWriter(simulator, task, rng).write(seed)
            if plan is None or (task.task_id, plan) in known:
                continue
            if simulator.execute(task, plan, seed).failure is None:
                known.add((task.task_id, plan))
                yield Execution(task.task_id, seed, plan)


class PlanWriter:
    """Writes one plan by trying its calls in the simulator; a refused call is drawn again."""

    def __init__(self, simulator: Simulator, task: Task, rng: np.random.Generator) -> None:
        self._simulator = simulator
        self._task = task
        self._rng = rng
        scene = simulator.world.scene
        rows = range(len(task.table))
        assets = [scene.asset_of(name) for name in task.table]
        self._movable = [row for row in rows if not scene.by_name[task.table[row]].fixed]
        self._hosts = [row for row in rows if assets[row].supports or assets[row].interiors]
        self._doors = [row for row in rows if assets[row].joints]
        self._carried: set[int] = set()
        self._opened: int | None = None

    def write(self, seed: int) -> Plan | None:
        """Return two transports and a door in random order, or None if nothing can be carried or opened."""
        self._simulator.reset(self._task, seed)
        parts: list[Callable[[], Sequence[SkillCall] | None]] = [self._transport, self._transport, self._door]
        plan: list[SkillCall] = []
        for index in self._rng.permutation(len(parts)):
            calls = parts[index]()
            if calls is None:
                return None
            plan += calls
        return tuple(plan)

    def _transport(self) -> list[SkillCall] | None:
        """Carry an object that was not carried before to another place: four calls."""
        for row in self._shuffled(self._movable):
            fetch = [SkillCall(Skill.MOVE, row), SkillCall(Skill.PICK_UP, row)]
            if row in self._carried or not self._succeeds(fetch):
                continue
            self._carried.add(row)
            for host in self._places():
                place = SkillCall(Skill.PLACE, host, relation=self._relation(host))
                deliver = [SkillCall(Skill.MOVE, host), place]
                if host != row and self._succeeds(deliver):
                    return fetch + deliver
            return None
        return None

    def _door(self) -> list[SkillCall] | None:
        for row in self._shuffled(self._doors):
            calls = [SkillCall(Skill.MOVE, row), SkillCall(Skill.OPEN, row)]
            if self._succeeds(calls):
                self._opened = row
                return calls
        return None

    def _places(self) -> Iterator[int]:
        """Yield places to try: half of the time the host that was just opened comes first."""
        if self._opened is not None and self._opened in self._hosts and self._rng.random() < 0.5:
            yield self._opened
        yield from self._shuffled(self._hosts)

    def _relation(self, host: int) -> PlaceRelation:
        asset = self._simulator.world.asset(self._task.table[host])
        if host == self._opened and asset.interiors:
            return PlaceRelation.INSIDE
        if self._rng.random() < UNDER_SHARE:
            return PlaceRelation.UNDER
        return PlaceRelation.ONTOP if asset.open_supports else PlaceRelation.INSIDE

    def _succeeds(self, calls: Sequence[SkillCall]) -> bool:
        return all(self._simulator.run_step(call).ok for call in calls)

    def _shuffled(self, rows: Sequence[int]) -> list[int]:
        return [rows[index] for index in self._rng.permutation(len(rows))[:CANDIDATES]]
