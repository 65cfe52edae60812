"""Pinned workload of the benchmarks: ten-call plans in furnished scenes, with the bundles of these scenes.

A workload is the file ``workload.json`` in a dataset's folder. The package ships one, so benchmarks need no arguments.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.wire.values import Rollout
from embomatrix.skills.parse import PlanError, parse_plan, plan_to_lines
from embomatrix.skills.syntax import Plan
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.records import Name, Record, SceneInvalidError, decode

FORMAT: Final = 1
PINNED: Final = Path(__file__).parents[1] / "data"
"""Folder of the dataset and workload that the package ships."""
WORKLOAD_FILE: Final = "workload.json"
SIZES: Final = (60, 150, 300, 600)
"""Scene sizes, in bodies, that costs are reported for. A scene counts for the nearest size, as a ratio."""


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
    """Plans to execute in one scene. ``bodies`` is the number of its objects."""

    scene_id: str
    bundle_digest: str
    bodies: int
    executions: tuple[Execution, ...]

    @property
    def rollouts(self) -> tuple[Rollout, ...]:
        """Every plan as a group of one rollout, because the plans differ in task and seed."""
        names = [f"{self.scene_id}/{number}" for number in range(len(self.executions))]
        return tuple(
            Rollout(name, name, self.bundle_digest, item.task_id, item.plan, item.seed)
            for name, item in zip(names, self.executions, strict=True)
        )


@dataclass(frozen=True, slots=True)
class Workload:
    """Scenes, their plans and their bundles by digest. ``bodies`` is the main size: headline figures are of its scenes."""

    seed: int
    bodies: int
    scenes: tuple[SceneWork, ...]
    bundles: Mapping[str, bytes] = field(default_factory=dict, compare=False, repr=False)

    @property
    def main(self) -> Workload:
        """The scenes of the main size."""
        return self.of_size(self.bodies)

    def of_size(self, bodies: int) -> Workload:
        """The scenes that count for one of ``SIZES``."""
        return self._with(scene for scene in self.scenes if nearest_size(scene.bodies) == bodies)

    def first(self, plans: int) -> Workload:
        """The same scenes with their first ``plans`` plans."""
        return self._with(replace(scene, executions=scene.executions[:plans]) for scene in self.scenes)

    def after(self, plans: int) -> Workload:
        """The same scenes without their first ``plans`` plans."""
        return self._with(replace(scene, executions=scene.executions[plans:]) for scene in self.scenes)

    @property
    def rollouts(self) -> tuple[Rollout, ...]:
        """Every plan once, scene by scene."""
        return tuple(rollout for scene in self.scenes for rollout in scene.rollouts)

    def sample(self, count: int) -> tuple[Rollout, ...]:
        """Up to ``count`` rollouts spread over the scenes: the first plan of each scene, then the second."""
        rounds = zip_longest(*(scene.rollouts for scene in self.scenes))
        return tuple(rollout for each in rounds for rollout in each if rollout is not None)[:count]

    def steps(self, scenes: int) -> tuple[tuple[Rollout, ...], ...]:
        """All rollouts as steps of a training run with ``scenes`` scenes each."""
        starts = range(0, len(self.scenes), scenes)
        return tuple(self._with(self.scenes[start : start + scenes]).rollouts for start in starts)

    def _with(self, scenes: Iterable[SceneWork]) -> Workload:
        return replace(self, scenes=tuple(scenes))


def nearest_size(bodies: int) -> int:
    """The one of ``SIZES`` that a scene counts for."""
    return min(SIZES, key=lambda size: abs(math.log(max(bodies, 1) / size)))


def load_workload(folder: Path) -> Workload:
    """Read a dataset's workload and the bundles of its scenes.

    Raises BenchError if the folder has no workload, or one for other scenes; DatasetError if it has no dataset.
    """
    dataset = Dataset.load(folder)
    workload = read_workload(folder / WORKLOAD_FILE)
    if not workload.main.scenes:
        raise BenchError(
            f"the workload in {folder} has no scene of about {workload.bodies} bodies: {_remedy(folder)}"
        )
    try:
        bundles = {
            scene.bundle_digest: dataset.bundle_bytes(scene.bundle_digest) for scene in workload.scenes
        }
    except DatasetError as error:
        raise BenchError(
            f"the workload in {folder} is of other scenes ({error}): {_remedy(folder)}"
        ) from error
    return replace(workload, bundles=bundles)


def workload_to_text(workload: Workload) -> str:
    """JSON with one line for each plan, which makes changes reviewable."""
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
    """Read a workload's file, without bundles. Raises BenchError that names the file and the remedy."""
    try:
        record = decode(path.read_bytes(), WorkloadJson, "workload")
        if record.format != FORMAT:
            raise SceneInvalidError("workload.format", f"found {record.format}: this version reads {FORMAT}")
        return Workload(record.seed, record.bodies, tuple(map(_scene_work, record.scenes)))
    except (OSError, ValueError, RecursionError) as error:
        raise BenchError(f"no workload can be read from {path} ({error}): {_remedy(path.parent)}") from error


def _remedy(folder: Path) -> str:
    return (
        f"write one with 'embomatrix bench workload --dataset={folder}', or leave --dataset out to use the "
        "dataset that the package ships"
    )


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
