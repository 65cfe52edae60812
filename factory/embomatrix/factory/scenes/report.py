"""What became of an inventory: how long it took, what stands in the scene, what was left out and why, what is wrong."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from embomatrix.factory.floorplan.layout import compactness
from embomatrix.factory.floorplan.spec import FloorPlanError
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.check import (
    ProblemKind,
    SceneProblem,
    check_in_engine,
    check_scene,
    check_settled,
)
from embomatrix.factory.scenes.floor import ReachableFloor
from embomatrix.factory.scenes.scene_file import SceneFileError, read_scene
from embomatrix.sim.engine import EngineError
from embomatrix.world.catalog import Catalog, CatalogError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from embomatrix.world.asset import Asset
    from embomatrix.world.scene import Scene

Json = dict[str, Any]

_COUNT: Final = re.compile(r"(\d+) (?:of (?:\d+|the) )?(\S+)")


@dataclass(frozen=True, slots=True)
class SceneReport:
    """Figures of one scene. Times are CPU seconds; shares lie in [0, 1]; ``error`` is a sentence when nothing was built."""

    scene_id: str
    seed: int
    error: str = ""
    rooms: int = 0
    doorways: int = 0
    windows: int = 0
    listed: int = 0
    """Items of the inventory without its doors, windows and floors."""
    placed: int = 0
    movable: int = 0
    build_s: float = 0.0
    check_s: float = 0.0
    compactness: float = 0.0
    """Share of the plan's bounding box that is floor or wall."""
    free_floor: float = 0.0
    """Share of the floor on which nothing stands."""
    reachable: float = 0.0
    """Share of the places where the robot fits that it can drive to."""
    stable: float = 0.0
    """Share of the movable objects that stay when all are let go."""
    unstable: tuple[str, ...] = ()
    placed_by_room: tuple[tuple[str, int], ...] = ()
    left_out: tuple[str, ...] = ()
    problems: tuple[SceneProblem, ...] = ()

    @property
    def sound(self) -> bool:
        return not self.error and not self.problems

    def to_json(self) -> Json:
        """Plain values, rounded."""
        value = asdict(self)
        value["placed_by_room"] = dict(self.placed_by_room)
        value["problems"] = [[p.kind.value, list(p.names), p.detail] for p in self.problems]
        for key in ("build_s", "check_s", "compactness", "free_floor", "reachable", "stable"):
            value[key] = round(value[key], 4)
        return value


def report_on(
    scene_id: str, seed: int, imported: Mapping[str, Asset] = MappingProxyType({})
) -> tuple[SceneReport, Scene | None]:
    """Build one scene, perhaps with imported assets, and check it; what fails is told in the report."""
    started = time.process_time()
    try:
        scene = build_base_scene(scene_id, seed=seed, imported=imported)
    except (CatalogError, FloorPlanError) as error:
        return SceneReport(scene_id, seed, error=str(error)), None
    built = time.process_time()
    try:
        report = report_of(scene, build_s=built - started)
    except EngineError as error:
        return SceneReport(scene_id, seed, error=str(error), build_s=built - started), scene
    return report, scene


def report_on_file(scene_id: str, seed: int, path: Path) -> SceneReport:
    """Check the scene in a file, of this name and seed; what fails is told in the report."""
    try:
        return report_of(read_scene(path))
    except (SceneFileError, EngineError) as error:
        return SceneReport(scene_id, seed, error=str(error))


def report_of(scene: Scene, *, build_s: float = 0.0) -> SceneReport:
    """Check a scene and count what is in it. Raises EngineError where the engine is missing."""
    started = time.process_time()
    settlement = check_settled(scene)
    problems = (
        *check_scene(scene),
        *check_in_engine(scene),
        *settlement.problems,
        *unaccounted(scene),
    )
    floor = ReachableFloor(scene)
    return SceneReport(
        scene_id=scene.scene_id,
        seed=scene.seed,
        rooms=len(scene.rooms),
        doorways=len(scene.doorways),
        windows=len(scene.windows),
        listed=sum(_listed(scene.base).values()),
        placed=len(scene.objects),
        movable=settlement.movable,
        build_s=build_s,
        check_s=time.process_time() - started,
        compactness=compactness(scene.rooms),
        free_floor=floor.free_share,
        reachable=floor.reachable_share,
        stable=settlement.stable_share,
        unstable=settlement.unstable,
        placed_by_room=tuple(sorted(Counter(item.room for item in scene.objects).items())),
        left_out=scene.left_out,
        problems=problems,
    )


def unaccounted(scene: Scene) -> tuple[SceneProblem, ...]:
    """Models of the base inventory of which fewer stand in the scene or among the left-out than are listed.

    A scene that is no base scene of the catalog has no inventory to compare with: nothing is unaccounted for.
    """
    placed = Counter(item.asset_id for item in scene.objects)
    told: Counter[str] = Counter()
    for sentence in scene.left_out:
        match = _COUNT.match(sentence)
        if match is not None:
            told[match[2]] += int(match[1])
    return tuple(
        SceneProblem(
            ProblemKind.UNACCOUNTED,
            (asset_id,),
            f"{count} are listed, {placed[asset_id]} stand in the scene, "
            f"{told[asset_id]} are told to be left out",
        )
        for asset_id, count in _listed(scene.base).items()
        if placed[asset_id] + told[asset_id] < count
    )


def _listed(scene_id: str) -> Mapping[str, int]:
    """How many of each model an inventory lists, empty for a scene that the catalog doesn't know."""
    catalog = Catalog.load()
    if scene_id not in catalog.scene_ids:
        return {}
    listed: Counter[str] = Counter()
    for room in catalog.inventory(scene_id).rooms:
        for category, model, count in room.items:
            listed[f"{category}-{model}"] += count
    return listed
