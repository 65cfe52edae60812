from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from embomatrix.factory.commands.scenes import app
from embomatrix.factory.scenes.batch import SceneBuildJob, run_batch
from embomatrix.factory.scenes.check import STABLE_SHARE, ProblemKind, check_scene, check_settled
from embomatrix.factory.scenes.floor import ReachableFloor
from embomatrix.factory.scenes.report import TABLE_COLUMNS, report_of, report_on, report_table, unaccounted
from embomatrix.factory.scenes.scene_file import read_scene
from embomatrix.host.limits import usable_cores
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.codec import scene_from_json
from embomatrix.world.geometry import ConvexPart, Pose, Shape

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

SMALL = "hotel_suite_small"
PAGE = Path(__file__).parents[3] / "docs" / "scenes.md"


def put(scene: Scene, name: str, x: float, y: float, z: float | None = None) -> Scene:
    """Return the scene with one object moved and its heading kept."""
    item = scene.by_name[name]
    pose = item.pose_world_asset
    there = Pose((x, y, pose.position_m[2] if z is None else z), pose.quat_xyzw)
    return replace(
        scene, objects=tuple(replace(o, pose_world_asset=there) if o is item else o for o in scene.objects)
    )


def problems(scene: Scene, kind: ProblemKind) -> list[tuple[str, ...]]:
    return [problem.names for problem in check_scene(scene) if problem.kind is kind]


def standing(scene: Scene) -> str:
    """Return an object on the floor that is higher than a window's sill."""
    return next(
        o.name
        for o in scene.objects
        if not o.host
        and scene.assets[o.asset_id].size_m[2] > 1.2
        and o.pose_world_asset.position_m[2] < scene.assets[o.asset_id].size_m[2] / 2 + 0.01
    )


def test_object_in_a_doorway_is_reported(flat: Scene) -> None:
    door = next(d for d in flat.doorways if d.rooms[1])
    name = standing(flat)
    assert not problems(flat, ProblemKind.DOORWAY)
    assert (name,) in problems(put(flat, name, *door.center_m), ProblemKind.DOORWAY)


def test_high_object_before_a_window_is_reported(flat: Scene) -> None:
    window = next(w for w in flat.windows if not w.rooms[1])
    room = next(r for r in flat.rooms if r.name == window.rooms[0])
    inward = np.sign(np.subtract(room.center_m, window.center_m)) * (
        (0.0, 0.4) if window.along == "x" else (0.4, 0.0)
    )
    x, y = np.add(window.center_m, inward)
    name = standing(flat)
    assert not problems(flat, ProblemKind.WINDOW)
    assert any(name in names for names in problems(put(flat, name, x, y), ProblemKind.WINDOW))
    height = flat.asset_of(name).size_m[2]
    sunk = put(flat, name, x, y, 0.8 - height / 2)
    assert not any(name in names for names in problems(sunk, ProblemKind.WINDOW))


def test_blocked_aisle_is_reported(flat: Scene) -> None:
    room = max(flat.rooms, key=lambda r: min(r.size_m))
    middle = room.center_m[1]
    x0, x1 = room.low_m[0] - 0.1, room.high_m[0] + 0.1
    bar = ConvexPart(Shape.BOX, Pose(((x0 + x1) / 2, middle, 0.5)), (x1 - x0, 0.1, 1.0))
    blocked = replace(flat, walls=(*flat.walls, bar), objects=(), doorways=flat.doorways[-1:])
    start = replace(flat.robot, x_m=room.center_m[0], y_m=middle + 0.6, room=room.name)
    assert (room.name,) in problems(replace(blocked, robot=start), ProblemKind.AISLE)


def test_narrow_doorway_is_reported(flat: Scene) -> None:
    narrow = replace(flat, doorways=tuple(replace(d, width_m=0.6) for d in flat.doorways))
    assert problems(narrow, ProblemKind.DOORWAY)


def test_base_scene_is_stable(flat: Scene) -> None:
    settlement = check_settled(flat)
    assert settlement.movable == sum(not item.fixed for item in flat.objects) > 0
    assert settlement.stable_share >= STABLE_SHARE
    assert settlement.problems == ()


def test_unsupported_objects_fall_and_are_reported(flat: Scene) -> None:
    scene = flat
    for item in flat.objects:
        if not item.fixed:
            x, y, z = item.pose_world_asset.position_m
            scene = put(scene, item.name, x, y, z + 0.3)
    settlement = check_settled(scene)
    assert settlement.stable_share < STABLE_SHARE
    assert [problem.kind for problem in settlement.problems] == [ProblemKind.UNSTABLE]


def test_vanished_item_is_unaccounted_for(flat: Scene) -> None:
    assert unaccounted(flat) == ()
    gone = flat.objects[-1]
    (problem,) = unaccounted(replace(flat, objects=flat.objects[:-1]))
    assert problem.names == (gone.asset_id,)


def test_report_counts_the_objects_of_the_scene(flat: Scene) -> None:
    report = report_of(flat)
    listed = sum(n for room in Catalog.load().inventory("Rs_int").rooms for *_, n in room.items)
    assert report.sound
    assert (report.rooms, report.listed, report.placed) == (5, listed, len(flat.objects))
    assert json.loads(json.dumps(report.to_json()))["left_out"] == list(flat.left_out)
    assert 0.8 < report.compactness <= 1.0


def test_empty_house_is_all_free_floor(flat: Scene) -> None:
    bare = ReachableFloor(replace(flat, objects=()))
    full = ReachableFloor(flat)
    assert bare.free_share == 1.0
    assert 0.3 < full.free_share < 0.95


def test_unknown_scene_gives_a_report_with_an_error() -> None:
    report, scene = report_on("Rs_itn", 0)
    assert scene is None
    assert "Rs_int" in report.error
    assert not report.sound


def test_scenes_are_built_in_parallel_and_written(tmp_path: Path) -> None:
    jobs = [SceneBuildJob(SMALL, seed, tmp_path / f"{seed}.json") for seed in (0, 1)]
    reports = sorted(run_batch(jobs, processes=2), key=lambda report: report.seed)
    assert [report.seed for report in reports] == [0, 1]
    assert all(report.sound for report in reports), [report.problems for report in reports]
    first, second = (scene_from_json(json.loads(job.path.read_text())) for job in jobs if job.path)
    assert first.seed == 0
    assert first.objects != second.objects
    assert {room.name for room in first.rooms} == {room.name for room in second.rooms}


def test_unknown_name_stops_a_batch_before_anything_is_built() -> None:
    with pytest.raises(CatalogError, match="Rs_int"):
        list(run_batch([SceneBuildJob("Rs_itn", 0), SceneBuildJob(SMALL, 0)], processes=1))


def test_check_writes_a_report_and_names_missing_objects(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    result = CliRunner().invoke(app, ["check", SMALL, "--report", str(path)])
    assert result.exit_code == 0, result.output
    (entry,) = json.loads(path.read_text())
    assert entry["scene_id"] == SMALL
    assert entry["problems"] == []
    assert ("for objects that were left out" in result.output) == bool(entry["left_out"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check"], "no scene is named"),
        (["check", SMALL, "--all"], "give names or --all"),
        (["build", "--all", "Rs_itn"], "give names or --all"),
        (["draw", "Rs_itn"], "Rs_int"),
    ],
)
def test_names_and_all_exclude_one_another(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert words in result.output
    assert "Traceback" not in result.output


def test_page_names_every_rule() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert [kind.value for kind in ProblemKind if f"`{kind.value}`" not in page] == []


def test_house_on_the_page_is_built_checked_and_drawn_by_the_commands_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = PAGE.read_text(encoding="utf-8")
    (printed,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    file = Path("docs/examples/two_bedroom_flat.toml")
    assert printed == (PAGE.parents[1] / file).read_text(encoding="utf-8")
    (tmp_path / file.parent).mkdir(parents=True)
    (tmp_path / file).write_text(printed, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^embomatrix scene (\w+ [^#\n]*two_bedroom_flat[^#\n]*)", page, re.MULTILINE)
    assert [command.split()[0] for command in commands] == ["build", "check", "draw", "draw"]
    for command in commands:
        done = CliRunner().invoke(app, command.split())
        assert done.exit_code == 0, done.output
    scene = read_scene(Path("scenes/two_bedroom_flat.json"))
    assert {room.name for room in scene.rooms} == set(re.findall(r"^\[rooms\.(\w+)\]", printed, re.MULTILINE))
    assert Path("pictures/two_bedroom_flat_plan.png").read_bytes().startswith(b"\x89PNG")


def test_build_of_a_house_names_what_has_no_place_and_counts_it(tmp_path: Path) -> None:
    house = tmp_path / "hall.toml"
    house.write_text(
        'scene = "hall"\n[rooms.corridor_0]\nsize_m = [4, 1.5]\nfurniture = {pool_table = 1, picture = 1}\n',
        encoding="utf-8",
    )
    report = tmp_path / "report.json"
    done = CliRunner().invoke(
        app, ["build", str(house), "--seed", "2", "--out", str(tmp_path), "--report", str(report)]
    )
    assert done.exit_code == 0, done.output
    assert "left out of hall: 1 pool_table-" in done.output
    (entry,) = json.loads(report.read_text())
    assert (entry["scene_id"], entry["seed"], entry["listed"], entry["placed"]) == ("hall", 2, 2, 1)
    assert read_scene(tmp_path / "hall.json").seed == 2


def test_two_house_files_of_one_name_are_refused(tmp_path: Path) -> None:
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).write_text('scene = "hut"\n[rooms.kitchen_0]\nsize_m = [3, 3]\n', encoding="utf-8")
    done = CliRunner().invoke(
        app, ["build", str(tmp_path / "a.toml"), str(tmp_path / "b.toml"), "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 2
    assert "both describe the scene 'hut': change `scene` in one of them" in done.output
    assert not (tmp_path / "out").exists()


def test_house_with_impossible_doors_ends_in_a_sentence(tmp_path: Path) -> None:
    around = "".join(f"[rooms.bedroom_{n}]\nsize_m = [9, 9]\n" for n in range(9))
    doors = ", ".join(f'{{rooms = ["closet_0", "bedroom_{n}"]}}' for n in range(9))
    house = tmp_path / "star.toml"
    house.write_text(f'scene = "star"\ndoors = [{doors}]\n[rooms.closet_0]\nsize_m = [1, 1]\n{around}')
    done = CliRunner().invoke(app, ["build", str(house), "--out", str(tmp_path)])
    assert done.exit_code == 1
    assert "most often has no wall" in done.output
    assert "Traceback" not in done.output


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_51_scenes_are_built_and_keep_every_rule(seed: int) -> None:
    jobs = [SceneBuildJob(scene_id, seed) for scene_id in Catalog.load().scene_ids]
    reports = list(run_batch(jobs, processes=usable_cores()))
    assert len(reports) == 51
    assert sum(report.rooms for report in reports) == 374
    wrong = {report.scene_id: report.error or report.problems for report in reports if not report.sound}
    assert not wrong


def test_table_of_scenes_with_seeds_fits_the_width_it_is_printed_with(flat: Scene) -> None:
    report = replace(report_of(flat), scene_id="school_computer_lab_and_infirmary", seed=100)
    out = io.StringIO()
    Console(file=out, width=TABLE_COLUMNS).print(report_table([report, report]))
    assert "…" not in out.getvalue()
    assert out.getvalue().splitlines()[1].split()[-2:] == ["100.0%", "0"]
