"""Reports of built scenes: time, contents, objects left out with the reason, and broken rules."""

import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from rich.table import Table

from embomatrix.factory.floorplan.house_file import HouseFileError, read_house
from embomatrix.factory.floorplan.layout import compactness
from embomatrix.factory.floorplan.spec import FloorPlanError
from embomatrix.factory.scenes.build import build_base_scene, build_house
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
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.scene import Scene

Json = dict[str, Any]

_COUNT: Final = re.compile(r"(\d+) (?:of (?:\d+|the) )?(\S+)")


@dataclass(frozen=True, slots=True)
class SceneReport:
    """Figures of one scene. Times are CPU seconds, shares lie in [0, 1]. ``error`` says why nothing was built."""

    scene_id: str
    seed: int
    error: str = ""
    rooms: int = 0
    doorways: int = 0
    windows: int = 0
    listed: int = 0
    """Items of the inventory, except doors, windows and floors."""
    placed: int = 0
    movable: int = 0
    build_s: float = 0.0
    check_s: float = 0.0
    compactness: float = 0.0
    """Share of the plan's bounding box that is floor or wall."""
    free_floor: float = 0.0
    """Share of the floor without objects."""
    stable: float = 0.0
    """Share of the movable objects that stay in place when all settle."""
    unstable: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    problems: tuple[SceneProblem, ...] = ()

    @property
    def sound(self) -> bool:
        return not self.error and not self.problems

    def to_json(self) -> Json:
        """Return a JSON-serialisable dict with rounded numbers."""
        value = asdict(self)
        value["problems"] = [[p.kind.value, list(p.names), p.detail] for p in self.problems]
        for key in ("build_s", "check_s", "compactness", "free_floor", "stable"):
            value[key] = round(value[key], 4)
        return value


def report_on(
    scene_id: str,
    seed: int,
    imported: Mapping[str, Asset] = MappingProxyType({}),
    *,
    background: bool = True,
    house: Path | None = None,
) -> tuple[SceneReport, Scene | None]:
    """Build one scene, perhaps with imported assets, and check it; the report contains failures.

    ``house`` is the file of a floor plan; without one, the scene is that of the catalog.
    """
    started = time.process_time()
    try:
        if house is None:
            scene = build_base_scene(scene_id, seed=seed, imported=imported, background=background)
        else:
            scene = build_house(read_house(house), seed=seed, imported=imported, background=background)
    except (CatalogError, FloorPlanError, HouseFileError) as error:
        return SceneReport(scene_id, seed, error=str(error)), None
    built = time.process_time()
    try:
        report = report_of(scene, build_s=built - started)
    except EngineError as error:
        return SceneReport(scene_id, seed, error=str(error), build_s=built - started), scene
    return report, scene


def report_on_file(scene_id: str, seed: int, path: Path) -> SceneReport:
    """Check the scene in a file; the report contains failures."""
    try:
        return report_of(read_scene(path))
    except (SceneFileError, EngineError) as error:
        return SceneReport(scene_id, seed, error=str(error))


def report_of(scene: Scene, *, build_s: float = 0.0) -> SceneReport:
    """Check a scene and count its contents. Raises EngineError if the engine is missing."""
    started = time.process_time()
    settlement = check_settled(scene)
    problems = (
        *check_scene(scene),
        *check_in_engine(scene),
        *settlement.problems,
        *unaccounted(scene),
    )
    return SceneReport(
        scene_id=scene.scene_id,
        seed=scene.seed,
        rooms=len(scene.rooms),
        doorways=len(scene.doorways),
        windows=len(scene.windows),
        listed=_count_listed(scene),
        placed=len(scene.objects),
        movable=settlement.movable,
        build_s=build_s,
        check_s=time.process_time() - started,
        compactness=compactness(scene.rooms),
        free_floor=ReachableFloor(scene).free_share,
        stable=settlement.stable_share,
        unstable=settlement.unstable,
        left_out=scene.left_out,
        problems=problems,
    )


def unaccounted(scene: Scene) -> tuple[SceneProblem, ...]:
    """Return a problem for each model listed more often than it is placed or reported as left out.

    A scene without an inventory in the catalog has nothing unaccounted for.
    """
    placed = Counter(item.asset_id for item in scene.objects)
    reported = _reported(scene)
    return tuple(
        SceneProblem(
            ProblemKind.UNACCOUNTED,
            (asset_id,),
            f"{count} are listed, {placed[asset_id]} are placed, {reported[asset_id]} are reported as left out",
        )
        for asset_id, count in _listed(scene.base).items()
        if placed[asset_id] + reported[asset_id] < count
    )


def _reported(scene: Scene) -> Counter[str]:
    """Return the number of each model that is reported as left out; doors, windows and floors stand under their words."""
    reported: Counter[str] = Counter()
    for sentence in scene.left_out:
        match = _COUNT.match(sentence)
        if match is not None:
            reported[match[2]] += int(match[1])
    return reported


def _count_listed(scene: Scene) -> int:
    """Return the number of items in the scene's inventory; of a house file, those that were placed or left out."""
    if scene.base in Catalog.load().scene_ids:
        return sum(_listed(scene.base).values())
    left_out = sum(n for word, n in _reported(scene).items() if not word.startswith(("window-", "door-")))
    return len(scene.objects) + left_out


def _listed(scene_id: str) -> Mapping[str, int]:
    """Return the number of each model in an inventory; empty for a scene that is not in the catalog."""
    catalog = Catalog.load()
    if scene_id not in catalog.scene_ids:
        return {}
    listed: Counter[str] = Counter()
    for room in catalog.inventory(scene_id).rooms:
        for category, model, count in room.items:
            listed[f"{category}-{model}"] += count
    return listed


TABLE_COLUMNS: Final = 100
"""Width of ``report_table`` in characters, also used for files and narrow terminals, which would cut figures off."""


def report_table(reports: Sequence[SceneReport]) -> Table:
    """Return a table with a row for each scene and a row of sums. Times are CPU seconds."""
    table = Table(box=None, pad_edge=False)
    table.add_column("scene", no_wrap=True)
    for name in ("build s", "rooms", "placed", "listed", "movable", "stable", "wrong"):
        table.add_column(name, justify="right", no_wrap=True)
    for report in reports:
        if report.error:
            table.add_row(_name(report), "not built")
            continue
        table.add_row(*_row(_name(report), [report]), f"{report.stable:.1%}", str(len(report.problems)))
    if len(reports) > 1:
        sums = _row(f"{len(reports)} scenes", reports)
        table.add_row(*sums, "", str(sum(len(report.problems) for report in reports)), style="bold")
    return table


def problem_lines(reports: Sequence[SceneReport]) -> Iterator[str]:
    """Yield a line for each problem and for each scene that could not be built."""
    for report in reports:
        if report.error:
            yield f"{_name(report)}: {report.error}"
        for problem in report.problems:
            yield f"{_name(report)}: {problem.kind}: {', '.join(problem.names)}: {problem.detail}"


def _name(report: SceneReport) -> str:
    return f"{report.scene_id} #{report.seed}" if report.seed else report.scene_id


def _row(name: str, reports: Sequence[SceneReport]) -> tuple[str, ...]:
    counts = ((r.rooms, r.placed, r.listed, r.movable) for r in reports)
    sums = (str(sum(column)) for column in zip(*counts, strict=True))
    return (name, f"{sum(r.build_s for r in reports):.1f}", *sums)
