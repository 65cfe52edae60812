from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from PIL import ImageColor
from typer.testing import CliRunner

from embomatrix.factory.commands.scenes import app
from embomatrix.factory.pictures.scene import FILL, draw_plan
from embomatrix.factory.pictures.sheet import draw_sheet, draw_views
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.sim.bullet.camera import (
    box_of,
    furnish_cutaway,
    furnish_whole,
    oblique_view,
    photograph_oblique,
    render_oblique,
)
from embomatrix.sim.bullet.photograph import Photographer
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.looks.rooms import CEILING, PANE
from embomatrix.sim.looks.view import View
from embomatrix.world.asset import Asset, Link
from embomatrix.world.geometry import ConvexPart, Pose, Shape

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.world.scene import Scene

HERE = Pose((0.0, 0.0, 0.0))


def test_plan_shows_more_than_walls(flat: Scene) -> None:
    pixels = np.asarray(draw_plan(flat))
    assert pixels.ndim == 3
    assert min(pixels.shape[:2]) > 500
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 12


def test_oblique_view_holds_the_whole_scene(flat: Scene) -> None:
    pixels = render_oblique(flat, width_px=320, height_px=240)
    assert pixels.shape == (240, 320, 3)
    background = (pixels == pixels[0, 0]).all(axis=2)
    assert 0.15 < background.mean() < 0.85
    edge = np.concatenate([background[0], background[-1], background[:, 0], background[:, -1]])
    assert edge.mean() > 0.95, "nothing is cut off at the edge of the picture"


def test_pictures_on_low_walls_are_left_out_and_what_stands_on_shelves_stays() -> None:
    scene = build_base_scene("Ihlen_1_int", seed=0)
    pictures = {item.name for item in scene.objects if scene.assets[item.asset_id].category == "picture"}
    with VisualScene(scene) as stage:
        furnish_cutaway(stage)
        shown = set(stage.owners.values())
    assert pictures - shown, "pictures hang on near walls: their walls are cut below them"
    assert pictures & shown, "pictures hang on far walls"
    assert {item.name for item in scene.objects if item.host} <= shown
    with VisualScene(scene) as stage:
        furnish_whole(stage)
        assert pictures <= set(stage.owners.values())


def test_plan_shows_its_windows(flat: Scene) -> None:
    lit, walled = (np.asarray(draw_plan(scene)) for scene in (flat, replace(flat, windows=())))
    blue = (0x6F, 0xC3, 0xE8)
    assert (lit == blue).all(axis=2).any()
    assert not (walled == blue).all(axis=2).any()


def test_crown_of_a_tree_hides_nothing_below_it(home: Scene) -> None:
    fridge = next(item for item in home.objects if home.assets[item.asset_id].category == "fridge")
    box = home.box_of(fridge.name)
    size = tuple(2 * extent for extent in box.size_m)
    tree = Asset(
        "tree-crown", "tree", "tree.n.01", size, 10.0, (Link("base", (ConvexPart(Shape.BOX, HERE, size),)),)
    )
    crown = replace(
        fridge, name="tree_1", asset_id="tree-crown", joints=(), pose_world_asset=Pose(box.center_m)
    )
    bare = replace(home, objects=(fridge,))
    grown = replace(bare, objects=(fridge, crown), assets={**home.assets, "tree-crown": tree})
    orange, green = (ImageColor.getrgb(FILL[kind]) for kind in ("opens", "plant"))
    shown, alone = (np.asarray(draw_plan(scene)) for scene in (grown, bare))
    assert (shown == green).all(axis=2).sum() > 1.5 * (alone == green).all(axis=2).sum()
    assert (shown == orange).all(axis=2).sum() > 0.8 * (alone == orange).all(axis=2).sum()


def test_sheet_holds_a_plan_in_every_cell(flat: Scene) -> None:
    pixels = np.asarray(draw_sheet([flat] * 5, columns=3, cell_px=120))
    assert pixels.shape == (2 * (120 + 16), 3 * 120, 3)
    for row, column in ((0, 0), (0, 2), (1, 1)):
        cell = pixels[row * 136 : row * 136 + 120, column * 120 : column * 120 + 120]
        assert len(np.unique(cell.reshape(-1, 3), axis=0)) > 6
    empty = pixels[136:, 240:]
    assert (empty == 255).all()


def test_unknown_scene_gets_one_sentence_with_close_names() -> None:
    result = CliRunner().invoke(app, ["show", "Rs_itn"])
    assert result.exit_code == 2
    assert "Rs_int" in result.output
    assert "Traceback" not in result.output


def test_render_writes_plan_view_and_robot_view(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["draw", "hotel_suite_small", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hotel_suite_small_eyes.png",
        "hotel_suite_small_plan.png",
        "hotel_suite_small_view.png",
    ]


def test_jpeg_replaces_rendered_pictures_and_leaves_plans(tmp_path: Path) -> None:
    arguments = ["draw", "hotel_suite_small", "--labels", "--format", "jpg", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hotel_suite_small_eyes.jpg",
        "hotel_suite_small_plan.png",
        "hotel_suite_small_view.jpg",
    ]
    assert (tmp_path / "hotel_suite_small_view.jpg").read_bytes()[:3] == b"\xff\xd8\xff"


def test_labels_are_refused_where_no_names_fit(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["draw", "Rs_int", "--as", "sheet", "--labels", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "leave out --labels" in " ".join(result.output.split())
    assert not any(tmp_path.iterdir())


def test_equal_scenes_give_equal_pictures(flat: Scene) -> None:
    first, second = (render_oblique(flat, width_px=160, height_px=120) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_photo_tells_the_objects_that_it_shows(flat: Scene) -> None:
    photo = photograph_oblique(flat, width_px=320, height_px=240)
    assert [each.pixels for each in photo.seen] == sorted((each.pixels for each in photo.seen), reverse=True)
    names = {each.name for each in photo.seen}
    large = [item for item in flat.objects if "bed" in item.name or "sofa" in item.name]
    assert large
    assert {item.name for item in large} <= names <= {item.name for item in flat.objects}
    for each in photo.seen:
        assert 0 <= each.column < 320
        assert 0 <= each.row < 240


def test_hidden_object_is_not_among_the_seen_ones(flat: Scene) -> None:
    with VisualScene(flat) as stage:
        furnish_cutaway(stage)
        photographer, view, region = Photographer(stage), oblique_view(flat.rooms, 4 / 3), box_of(flat.rooms)
        name = photographer.shoot(view, region, 160, 120).seen[0].name
        before = photographer.shoot(view, region, 160, 120)
        stage.hide(name)
        after = photographer.shoot(view, region, 160, 120)
    assert name in {each.name for each in before.seen}
    assert name not in {each.name for each in after.seen}
    assert (before.pixels != after.pixels).any()


def test_furniture_casts_a_soft_shadow_on_the_floor(flat: Scene) -> None:
    """Bright shades between light and shadow occur: a hard shadow has two."""
    bare = replace(flat, objects=(), background=())
    full, empty = (render_oblique(scene, width_px=320, height_px=240).astype(int) for scene in (flat, bare))
    darker = (empty - full).mean(axis=2)
    shades = darker[(darker > 4) & (darker < 60)]
    assert len(shades) > 500
    assert shades.std() > 5


def test_rooms_have_ceilings_and_windows_have_panes(flat: Scene) -> None:
    with VisualScene(flat) as stage:
        furnish_whole(stage)
        room = max(flat.rooms, key=lambda each: each.size_m[0] * each.size_m[1])
        x, y = room.center_m
        up = View.toward((x, y, 1.0), (x, y + 0.3, room.height_m), 30.0, 4 / 3, 0.05, 30.0)
        buffers = stage.capture(up, 40, 30)
        above = stage.parts[int(np.bincount(buffers.body[buffers.body >= 0]).argmax())]
        panes = [seen for seen in stage.parts.values() if seen.material is PANE]
    assert above.material is CEILING
    assert len(panes) == len(flat.windows)


def test_check_accepts_a_base_scene() -> None:
    result = CliRunner().invoke(app, ["check", "hotel_suite_small"])
    assert result.exit_code == 0, result.output
    assert "nothing wrong" in result.output


def test_relations_are_drawn_by_a_command(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["draw", "--as", "relations", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert [path.name for path in tmp_path.iterdir()] == ["relations.png"]


def test_unwritable_report_is_rejected_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    report = tmp_path / "file" / "report.json"
    for arguments in (["check", "--all"], ["build", "--all", "--out", str(tmp_path / "out")]):
        result = CliRunner().invoke(app, [*arguments, "--report", str(report)])
        assert result.exit_code == 2
        assert "report.json can't be written" in " ".join(result.output.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_views_of_several_scenes_stand_side_by_side(flat: Scene) -> None:
    pixels = np.asarray(draw_views([flat, flat], width_px=120))
    assert pixels.shape == (90, 240, 3)
    assert (pixels[:, :120] == pixels[:, 120:]).all()
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50
