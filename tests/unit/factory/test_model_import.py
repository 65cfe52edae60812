"""Models from OBJ and GLB files become assets of the catalog's size and mass, or a clear error."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from embomatrix.factory.assets.check import check_asset
from embomatrix.factory.commands.assets import app
from embomatrix.factory.commands.scenes import app as scene_app
from embomatrix.factory.importers.assemble import ImportedAsset, convex_part, import_model, read_model
from embomatrix.factory.importers.convex import MAX_HULLS, MAX_VERTICES, Coacd, by_components
from embomatrix.factory.importers.convex import _kept as kept_pieces
from embomatrix.factory.importers.model import Mesh, ModelFileError
from embomatrix.factory.importers.shelf import read_assets, save_asset
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.world.asset import Credit, JointKind
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Aabb, Pose, Shape

CATALOG = Catalog.load()
CREDIT = Credit("A. Maker", "CC0-1.0", "a drawing")
HERE = Pose((0.0, 0.0, 0.0))
SAMPLES = Path(__file__).parents[4] / "shared" / "data" / "sweethome3d_cc0_sample.zip"
CUPBOARD = (
    # name, low and high corner; x width, y height, z depth with the front at +z, in centimetres
    ("back", (0, 0, 0), (60, 80, 2)),
    ("floor", (0, 0, 2), (60, 2, 48)),
    ("roof", (0, 78, 2), (60, 80, 48)),
    ("left", (0, 2, 2), (2, 78, 48)),
    ("right", (58, 2, 2), (60, 78, 48)),
    ("sweethome3d_hinge_1", (0, 10, 49), (1, 70, 50)),
    ("sweethome3d_opening_on_hinge_1", (1, 2, 48.5), (60, 78, 50)),
)


def obj_text(boxes: tuple[tuple[str, tuple[float, ...], tuple[float, ...]], ...]) -> str:
    lines, count = [], 0
    for name, low, high in boxes:
        mesh = trimesh.creation.box(bounds=(low, high))
        lines.append(f"g {name}")
        lines += [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
        lines += [f"f {a + 1 + count}/1/1 {b + 1 + count} {c + 1 + count}" for a, b, c in mesh.faces]
        count += len(mesh.vertices)
    return "\n".join(lines)


def imported(path: Path, category: str, model: str = "") -> ImportedAsset:
    return import_model(CATALOG, read_model(path), category, model, CREDIT, by_components)


def test_obj_gets_id_size_and_mass_of_a_catalog_model(tmp_path: Path) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text(CUPBOARD))
    result = imported(path, "bottom_cabinet", "songes")
    asset, entry = result.asset, CATALOG.model("bottom_cabinet", "songes")
    assert asset.asset_id == entry.asset_id
    assert asset.mass_kg == CATALOG.category("bottom_cabinet").mass_kg
    assert asset.credit == CREDIT
    box = Aabb.around(part.aabb(HERE) for item in asset.links for part in item.parts)
    assert box.size_m == pytest.approx(entry.size_m, abs=1e-5)
    scales = np.asarray(entry.size_m) / (0.50, 0.60, 0.80)
    assert result.stretch == pytest.approx(scales.max() / scales.min())
    assert not check_asset(CATALOG, asset)


def test_hinge_of_sweet_home_3d_opens_towards_the_front(tmp_path: Path) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text(CUPBOARD))
    asset = imported(path, "bottom_cabinet", "songes").asset
    ((name, hinge),) = asset.joints
    assert (name, hinge.kind, hinge.upper) == ("door1", JointKind.REVOLUTE, round(math.pi / 2, 6))
    assert hinge.origin_m[1] < 0
    assert hinge.axis == (0.0, 0.0, -1.0)  # hinged at -y: the free edge at +y comes forward
    (inside,) = asset.interiors
    assert inside.closed_by == ("door1",)
    assert min(inside.size_m) > 0.3
    (floor,) = [surface for surface in asset.supports if surface.interior]
    assert floor.center_m[2] == pytest.approx(-asset.size_m[2] / 2, abs=0.06)
    assert [surface.name for surface in asset.supports if not surface.interior] == ["top"]


def test_every_compartment_of_a_shelf_is_a_cavity_with_its_own_floor(tmp_path: Path) -> None:
    path = tmp_path / "shelf.obj"
    boards = (("board1", (2, 26, 2), (58, 28, 48)), ("board2", (2, 52, 2), (58, 54, 48)))
    path.write_text(obj_text((*CUPBOARD[:5], *boards)))
    asset = imported(path, "bookcase").asset
    assert [interior.name for interior in asset.interiors] == ["shelf1", "shelf2", "shelf3"]
    assert all(interior.closed_by == () for interior in asset.interiors)
    floors = [surface for surface in asset.supports if surface.interior]
    assert all(surface.clearance_m < 0.4 * asset.size_m[2] for surface in floors)
    bottom, height = -asset.size_m[2] / 2, asset.size_m[2]
    assert [(f.center_m[2] - bottom) / height for f in floors] == pytest.approx(
        [2 / 80, 28 / 80, 54 / 80], abs=0.03
    )


def test_open_box_holds_objects_that_stick_out(tmp_path: Path) -> None:
    path = tmp_path / "crate.obj"
    front = ("front", (0, 0, 48), (60, 80, 50))
    path.write_text(obj_text((*(board for board in CUPBOARD[:5] if board[0] != "roof"), front)))
    asset = imported(path, "packing_box").asset
    assert [interior.name for interior in asset.interiors] == ["inside"]
    (floor,) = [surface for surface in asset.supports if surface.interior]
    assert floor.clearance_m > 1.0


def test_rail_of_sweet_home_3d_is_a_drawer(tmp_path: Path) -> None:
    path = tmp_path / "drawer.obj"
    rail = ("sweethome3d_unique_rail", (29, 1, 2), (31, 2, 48))
    drawer = ("sweethome3d_opening_on_rail_1", (3, 10, 4), (57, 30, 50))
    path.write_text(obj_text((*CUPBOARD[:5], rail, drawer)))
    ((name, slide),) = imported(path, "bottom_cabinet", "songes").asset.joints
    assert (name, slide.kind, slide.axis) == ("drawer1", JointKind.PRISMATIC, (1.0, 0.0, 0.0))
    depth = 0.46 * CATALOG.model("bottom_cabinet", "songes").size_m[0] / 0.50
    assert slide.upper == pytest.approx(0.8 * depth, rel=0.01)


def test_opening_without_a_hinge_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text((*CUPBOARD[:5], CUPBOARD[6])))
    with pytest.raises(ModelFileError, match="has no sweethome3d_hinge_1"):
        read_model(path)


def test_missing_abilities_of_a_model_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "block.obj"
    path.write_text(obj_text((("base", (0, 0, 0), (70, 170, 70)),)))
    result = imported(path, "fridge")
    assert not result.asset.can("openable")
    assert [lack.split(":")[1].strip() for lack in result.lacks] == [
        "this model has no group that moves", "this model has no cavity that is large enough",
    ]  # fmt: skip


def test_glb_is_read_with_the_poses_of_its_nodes(tmp_path: Path) -> None:
    scene: Any = trimesh.Scene()
    for size, height in (((1.0, 0.1, 0.6), 1.0), ((0.1, 1.0, 0.1), 0.45)):
        lifted = np.eye(4)
        lifted[1, 3] = height
        scene.add_geometry(trimesh.creation.box(size), transform=lifted)
    path = tmp_path / "table.glb"
    path.write_bytes(scene.export(file_type="glb"))
    asset = imported(path, "breakfast_table").asset
    assert {part.shape for part in asset.links[0].parts} == {Shape.BOX}
    (top,) = asset.supports
    assert top.size_m == pytest.approx(asset.size_m[:2], rel=0.06)
    assert top.center_m[2] == pytest.approx(asset.size_m[2] / 2, abs=0.03)


def test_glb_whose_faces_name_vertices_that_it_lacks_is_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    data = bytearray(box.export(file_type="glb"))
    at = data.index(box.faces.astype("<u4").tobytes())
    data[at : at + 4] = (300).to_bytes(4, "little")
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    with pytest.raises(ModelFileError, match="a face names a vertex outside"):
        imported(path, "carton")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.obj", b"", "has 0 bytes"),
        ("a.obj", b"v 0 0 0\nv 1 0 zero", "line 2"),
        ("a.obj", b"v 0 0 0\nf 1 2 3", "line 2"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0", "contains no face"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3", "not a finite number"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "expected a solid, not a sheet"),
        ("a.glb", b"glTF but not really", "be read as glb"),
        ("a.blend", b"BLENDER", "ends in '.blend': expected one of .glb, .obj, .stl, .urdf"),
    ],
)
def test_damaged_mesh_file_is_named(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ModelFileError, match=message):
        imported(path, "carton")


@given(st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=120))
def test_convex_part_contains_its_points_within_a_few_millimetres(points: list[tuple[float, ...]]) -> None:
    cloud = np.array(points)
    part = convex_part(cloud)
    box = part.aabb(HERE)
    assert len(part.vertices_m) <= MAX_VERTICES
    assert min(part.size_m) >= 0.001
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    assert (np.asarray(box.low_m) <= low + 1e-5).all()
    assert (np.asarray(box.high_m) >= high - 1e-5).all()
    assert (np.asarray(box.size_m) <= np.maximum(high - low, 0.0021) + 1e-5).all()


def test_too_many_components_are_joined_to_sixteen() -> None:
    rng = np.random.default_rng(0)
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    middles = rng.uniform(0, 3, (40, 3))
    vertices = np.vstack([cube.vertices + middle for middle in middles])
    faces = np.vstack([cube.faces + number * len(cube.vertices) for number in range(40)])
    pieces = by_components(Mesh(vertices, faces), MAX_HULLS)
    assert len(pieces) == MAX_HULLS
    assert np.vstack(pieces).min(axis=0) == pytest.approx(vertices.min(axis=0))


def test_decomposition_is_cached_by_content_and_damaged_files_are_ignored(tmp_path: Path) -> None:
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = Mesh(np.asarray(cube.vertices), np.asarray(cube.faces))
    moved = Mesh(mesh.vertices + 1e-9, mesh.faces)
    cutter = Coacd(tmp_path)
    assert cutter.key(mesh, 16) == Coacd(tmp_path).key(mesh, 16)
    assert len({cutter.key(mesh, 16), cutter.key(moved, 16), cutter.key(mesh, 8)}) == 3
    kept = [mesh.vertices[:4].tolist()]
    (tmp_path / f"{cutter.key(mesh, 16)}.json").write_text(json.dumps(kept))
    assert np.asarray(cutter(mesh, 16)).tolist() == kept
    for damaged in ("{", "[]", "[[[0, 0]]]", "[[[1e999, 0, 0]]]", "[" + "9" * 400 + "]"):
        (tmp_path / "damaged.json").write_text(damaged)
        assert kept_pieces(tmp_path / "damaged.json") is None


def test_folder_of_assets_is_read_back_equal_and_damaged_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "box.obj"
    path.write_text(obj_text((("base", (0, 0, 0), (7, 7, 7)),)))
    asset = imported(path, "apple").asset
    shelf = tmp_path / "shelf"
    written = save_asset(shelf, asset)
    assert read_assets(shelf) == {asset.asset_id: asset}
    written.write_text(written.read_text().replace('"mass_kg"', '"mass"'))
    with pytest.raises(ModelFileError, match=str(written)):
        read_assets(shelf)
    with written.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ModelFileError, match="over 4,194,304 bytes"):
        read_assets(shelf)
    with pytest.raises(ModelFileError, match="contains no file"):
        read_assets(tmp_path)
    with pytest.raises(ModelFileError, match="is not a folder"):
        read_assets(tmp_path / "nowhere")


def test_command_writes_an_asset_or_one_line_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text(CUPBOARD))
    said = [
        "--creator",
        "A. Maker",
        "--licence",
        "CC0-1.0",
        "--out",
        str(tmp_path / "shelf"),
        "--cut",
        "components",
    ]
    done = CliRunner().invoke(app, ["import", str(path), "--category", "bottom_cabinet", *said])
    assert done.exit_code == 0, done.output
    assert "links 2" in done.output
    (asset,) = read_assets(tmp_path / "shelf").values()
    assert asset.credit == Credit("A. Maker", "CC0-1.0", "cupboard.obj")
    for wrong in (["--category", "bottom_cabinets"], ["--category", "bottom_cabinet", "--model", "nope"]):
        refused = CliRunner().invoke(app, ["import", str(path), *said, *wrong])
        assert refused.exit_code == 2
        assert "unknown" in refused.output
        assert "Traceback" not in refused.output


def test_command_reports_a_mug_that_is_too_narrow(tmp_path: Path) -> None:
    sides = (("left", (0, 10, 0), (36, 100, 100)), ("right", (64, 10, 0), (100, 100, 100)))
    ends = (("back", (36, 10, 0), (64, 100, 36)), ("front", (36, 10, 64), (64, 100, 100)))
    path = tmp_path / "mug.obj"
    path.write_text(obj_text((("floor", (0, 0, 0), (100, 10, 100)), *sides, *ends)))
    said = ["--creator", "A. Maker", "--licence", "CC0-1.0", "--out", str(tmp_path), "--cut", "components"]
    done = CliRunner().invoke(app, ["import", str(path), "--category", "mug", *said])
    assert done.exit_code == 0, done.output
    assert "cavities 1" in done.output
    assert "fillable: its largest cavity is 0.0" in done.output


@pytest.mark.parametrize(
    ("model", "words"), [("bamfsz", " Rs_int,"), ("songes", "furniture = {bottom_cabinet-songes = 1}")]
)
def test_command_names_the_scenes_that_use_the_model(tmp_path: Path, model: str, words: str) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text(CUPBOARD))
    said = ["--creator", "A. Maker", "--licence", "CC0-1.0", "--out", str(tmp_path), "--cut", "components"]
    done = CliRunner().invoke(
        app, ["import", str(path), "--category", "bottom_cabinet", "--model", model, *said]
    )
    assert done.exit_code == 0, done.output
    assert words in done.output


def sample(tmp_path: Path, name: str) -> Path:
    if not SAMPLES.is_file():
        pytest.skip("the sample of Sweet Home 3D's models is not here")
    with zipfile.ZipFile(SAMPLES) as archive:
        return Path(archive.extract(f"Blend Swap CC-0_{name}.obj", tmp_path))


@pytest.mark.parametrize(
    ("name", "category"),
    [("table", "breakfast_table"), ("sinkCabinet", "bottom_cabinet")],
)
def test_models_of_sweet_home_3d_become_assets(tmp_path: Path, name: str, category: str) -> None:
    result = imported(sample(tmp_path, name), category)
    assert result.stretch < 1.25
    assert all(len(item.parts) <= MAX_HULLS for item in result.asset.links)
    box = Aabb.around(part.aabb(HERE) for item in result.asset.links[:1] for part in item.parts)
    assert box.size_m[:2] == pytest.approx(result.asset.size_m[:2], rel=0.05)
    assert any(surface.name == "top" for surface in result.asset.supports)


@pytest.mark.slow
def test_cup_is_decomposed_once_holds_a_probe_and_keeps_its_credit(tmp_path: Path) -> None:
    pytest.importorskip("coacd", reason="needs embomatrix[importers]")
    wall = [(0.0, 0.0), (4.0, 0.0), (4.0, 9.0), (3.5, 9.0), (3.5, 0.5), (0.0, 0.5)]
    cup: Any = trimesh.creation.revolve(wall, sections=24)
    path = tmp_path / "cup.stl"
    path.write_bytes(cup.export(file_type="stl"))
    raw, cutter = read_model(path), Coacd(tmp_path / "cache")
    asset = import_model(CATALOG, raw, "mug", "", CREDIT, cutter).asset
    assert 4 <= len(asset.links[0].parts) <= MAX_HULLS
    assert not check_asset(CATALOG, asset), "it is fillable: a ball of 3 cm rests in it"
    assert asset.credit == CREDIT
    (kept,) = (tmp_path / "cache").glob("*.json")
    written = kept.stat().st_mtime_ns
    assert import_model(CATALOG, raw, "mug", "", CREDIT, cutter).asset == asset
    assert kept.stat().st_mtime_ns == written


def test_scene_is_built_with_the_imported_asset_in_place_of_the_generated_one(tmp_path: Path) -> None:
    path = tmp_path / "cupboard.obj"
    path.write_text(obj_text(CUPBOARD))
    save_asset(tmp_path / "shelf", imported(path, "stand", "oyenza").asset)
    scene = build_base_scene("hotel_suite_small", imported=read_assets(tmp_path / "shelf"))
    assert scene.assets["stand-oyenza"].credit == CREDIT
    assert {asset.credit for asset in scene.assets.values()} == {CREDIT, None}


def test_folder_without_assets_is_refused_before_anything_is_built(tmp_path: Path) -> None:
    said = ["build", "Rs_int", "--out", str(tmp_path / "out"), "--assets", str(tmp_path / "nowhere")]
    refused = CliRunner().invoke(scene_app, said)
    assert refused.exit_code == 2
    assert "is not a folder" in refused.output
    assert not (tmp_path / "out").exists()
