"""Materials, patterns and shading of pictures, without a renderer."""

import numpy as np
import pytest

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.sim.looks.light import LAMPS, shadow_maps
from embomatrix.sim.looks.materials import MATERIALS, MaterialKind, Pattern
from embomatrix.sim.looks.parts import material_of, part_materials
from embomatrix.sim.looks.patterns import UNIT, atlas
from embomatrix.sim.looks.rooms import PANE, floor_of, wall_of
from embomatrix.sim.looks.shading import FINER, NOTHING, Rendering, RoomTints, shaded
from embomatrix.sim.looks.surfaces import HullPlanes, surface_points, table_of
from embomatrix.sim.looks.view import View
from embomatrix.sim.looks.words import WORDS, content_by_words, kind_by_words
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, Pose, Shape

CATALOG = Catalog.load()
WIDTH, HEIGHT = 24, 18


def test_every_kind_of_material_has_a_look() -> None:
    assert set(MATERIALS) == set(MaterialKind)


def test_no_word_names_two_materials() -> None:
    words = [word for listed in WORDS.values() for word in listed.split()]
    assert len(words) == len(set(words))


def test_every_category_of_the_catalog_has_a_material_by_its_name() -> None:
    assert [name for name in CATALOG.category_names if kind_by_words(name) is None] == []


@pytest.mark.parametrize(
    ("category", "kind"),
    [
        ("breakfast_table", MaterialKind.OAK),
        ("fridge", MaterialKind.STEEL),
        ("plate", MaterialKind.PORCELAIN),
        ("lettuce", MaterialKind.LEAFY),
        ("half_lettuce", MaterialKind.LEAFY),
        ("steak", MaterialKind.MEAT),
        ("half_beefsteak_tomato", MaterialKind.RED),
        ("wooden_spoon", MaterialKind.OAK),
        ("table_knife", MaterialKind.STEEL),
        ("bottle_of_wine", MaterialKind.BOTTLE),
        ("tomato_paste_can", MaterialKind.TIN),
        ("sofa", MaterialKind.UPHOLSTERY),
        ("antique_oak_table", MaterialKind.OAK),
    ],
)
def test_category_has_the_material_of_the_thing(category: str, kind: MaterialKind) -> None:
    assert kind_by_words(category) is kind


def test_package_has_the_colour_of_its_content() -> None:
    assert content_by_words("tomato_paste_can") is MaterialKind.RED
    assert material_of("tomato_paste_can").color == MATERIALS[MaterialKind.RED].color
    assert material_of("tomato_paste_can").pattern is Pattern.LABEL


def test_unknown_things_are_wood_if_large_and_plastic_if_small() -> None:
    assert material_of("zzz", large=True).pattern is Pattern.GRAIN
    assert material_of("zzz").color in MATERIALS[MaterialKind.PLASTIC].palette


def test_books_of_different_models_differ_and_equal_ones_do_not() -> None:
    colors = {material_of("hardback", salt=str(number)).color for number in range(20)}
    assert len(colors) >= 4
    assert material_of("hardback", salt="a") == material_of("hardback", salt="a")


@pytest.mark.parametrize(
    ("category", "kinds"),
    [
        ("tree", {MaterialKind.BARK, MaterialKind.FOLIAGE}),
        ("pot_plant", {MaterialKind.TERRACOTTA, MaterialKind.FOLIAGE}),
        ("floor_lamp", {MaterialKind.IRON, MaterialKind.LAMPSHADE}),
        ("standing_tv", {MaterialKind.BLACK_PLASTIC, MaterialKind.SCREEN}),
    ],
)
def test_parts_of_one_object_have_their_own_materials(category: str, kinds: set[MaterialKind]) -> None:
    asset = build_asset(CATALOG, category, CATALOG.models_of(category)[0].model_id)
    assert set(part_materials(asset)) == {MATERIALS[kind] for kind in kinds}


def test_drawers_and_doors_stand_out_from_their_body() -> None:
    asset = build_asset(CATALOG, "bottom_cabinet", CATALOG.models_of("bottom_cabinet")[0].model_id)
    body, *_, door = part_materials(asset)
    assert door.pattern is Pattern.PANEL
    assert sum(door.color) > sum(body.color)


def test_every_pattern_has_a_tile_that_keeps_the_brightness() -> None:
    book = atlas()
    for number, pattern in enumerate(Pattern):
        start = book.starts[number, 0]
        tile = book.texels[start : start + 256 * 256, :3] / UNIT
        if pattern not in (Pattern.PICTURE, Pattern.SCREEN, Pattern.LABEL):
            assert 0.85 < tile.mean() < 1.1, pattern


def test_distant_patterns_fade_to_their_mean() -> None:
    book = atlas()
    number = np.full(50, [*Pattern].index(Pattern.PLANKS))
    spots = np.linspace(0.01, 0.99, 50).astype(np.float32)
    near, _ = book.look_up(number, spots, spots, np.full(50, 0.001, np.float32))
    far, _ = book.look_up(number, spots, spots, np.full(50, 2.0, np.float32))
    assert near.std() > 0.02
    assert len(np.unique(far, axis=0)) == 1


def test_rooms_have_floors_of_their_type() -> None:
    assert floor_of("bathroom").pattern is Pattern.TILES
    assert floor_of("living_room").pattern is Pattern.PLANKS
    assert floor_of("garden").pattern is Pattern.GRASS
    assert wall_of("bathroom") != wall_of("living_room")
    for name in CATALOG.scene_ids:
        for room in CATALOG.inventory(name).rooms:
            assert floor_of(room.type).pattern is not Pattern.PLAIN


def test_points_and_pixels_of_a_view_belong_together() -> None:
    view = View.toward((3.0, -2.0, 2.5), (0.0, 0.5, 0.2), 50.0, WIDTH / HEIGHT, 0.1, 20.0)
    rows, columns = np.array([2, 9, 17]), np.array([1, 12, 23])
    points = view.eye_m + view.rays(rows, columns, WIDTH, HEIGHT) * np.array([[1.0], [2.0], [7.0]])
    found = view.project(points, WIDTH, HEIGHT)
    np.testing.assert_allclose(found[:, 0], columns + 0.5, atol=1e-4)
    np.testing.assert_allclose(found[:, 1], rows + 0.5, atol=1e-4)
    np.testing.assert_allclose(found[:, 2], [1.0, 2.0, 7.0], rtol=1e-5)


def test_normals_of_shapes_point_outwards() -> None:
    plain = MATERIALS[MaterialKind.PORCELAIN]
    corners = tuple((x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))
    parts = [
        (ConvexPart(Shape.BOX, IDENTITY, (1.0, 1.0, 1.0)), IDENTITY, plain),
        (ConvexPart(Shape.CYLINDER, IDENTITY, (1.0, 1.0, 2.0)), IDENTITY, plain),
        (ConvexPart(Shape.SPHERE, IDENTITY, (1.0, 1.0, 1.0)), IDENTITY, plain),
        (ConvexPart(Shape.HULL, IDENTITY, (1.0, 1.0, 1.0), corners), IDENTITY, plain),
    ]
    table = table_of(parts, HullPlanes())
    turned = Pose.from_xyz_yaw(0.0, 0.0, 0.0, np.pi / 2)
    quarter = table_of([(parts[0][0], turned, plain)], HullPlanes())
    points = np.array([(0.5, 0.1, 0.0), (0.0, 0.1, 1.0), (0.3, 0.4, 0.0), (0.0, 0.5, 0.1)], np.float32)
    rays = -points
    found = surface_points(table, np.arange(4), points, rays, atlas().tile_m).normal
    np.testing.assert_allclose(found, [(1, 0, 0), (0, 0, 1), (0.6, 0.8, 0), (0, 1, 0)], atol=0.02)
    spun = surface_points(quarter, np.zeros(1, np.intp), points[:1], rays[:1], atlas().tile_m).normal
    np.testing.assert_allclose(spun, [(1, 0, 0)], atol=1e-5)


def test_light_casts_shadows_only_below_what_stops_it() -> None:
    """Every lamp sees a plate at a height of 0.4 m over the middle of a floor."""

    def depth_from(view: View, side: int) -> np.ndarray:
        rows, columns = np.divmod(np.arange(side * side), side)
        rays = view.rays(rows, columns, side, side).astype(float)
        at_plate = (0.4 - view.eye_m[2]) / rays[:, 2]
        on_floor = -view.eye_m[2] / rays[:, 2]
        x, y = (view.eye_m[axis] + rays[:, axis] * at_plate for axis in (0, 1))
        distance = np.where((abs(x) < 0.5) & (abs(y) < 0.5), at_plate, on_floor)
        near, far = view.near_m, view.far_m
        return ((far - far * near / distance) / (far - near)).reshape(side, side).astype(np.float32)

    maps = shadow_maps(Aabb((-2.0, -2.0, 0.0), (2.0, 2.0, 1.5)), 128, depth_from)
    assert len(maps) == len(LAMPS)
    assert np.isclose(sum(lamp.share for lamp in LAMPS), 1.0)
    spots = np.array([(0.0, 0.0, 0.41), (1.9, -1.9, 0.01), (0.0, 0.0, 0.01)], np.float32)
    light = sum(each.lamp.share * each.light_at(spots, np.full(3, 0.8, np.float32)) for each in maps)
    assert light[0] > 0.95, "on the plate"
    assert light[1] > 0.95, "far from it"
    assert light[2] < 0.4, "below it only the lowest lamps shine"


def floor_picture(*, outdoors: bool, pane: bool = False) -> np.ndarray:
    """Return a picture whose lower half is a floor, seen from above, or a pane."""
    view = View.toward((0.0, -3.0, 1.5), (0.0, 0.0, 1.0), 60.0, WIDTH / HEIGHT, 0.1, 50.0)
    material = PANE if pane else floor_of("living_room")
    part = ConvexPart(Shape.BOX, IDENTITY, (8.0, 8.0, 0.04))
    table = table_of([(part, Pose((0.0, 0.0, -0.02)), material)], HullPlanes())
    size = (FINER * HEIGHT, FINER * WIDTH)
    rows, columns = np.divmod(np.arange(size[0] * size[1]), size[1])
    rays = view.rays(rows, columns, size[1], size[0])
    distance = np.where(rays[:, 2] < -0.05, -view.eye_m[2] / np.minimum(rays[:, 2], -0.05), 40.0)
    below = (rays[:, 2] < -0.05) & (distance < 6)
    depth = (view.far_m - view.far_m * view.near_m / distance) / (view.far_m - view.near_m)
    rendering = Rendering(
        view,
        depth.reshape(size).astype(np.float32),
        np.where(below, 0, NOTHING).reshape(size),
        np.zeros((*size, 3), np.uint8),
    )
    none = np.zeros(0, np.intp)
    panes = np.zeros(1, np.intp) if pane else none
    tints = RoomTints(np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32), none, panes)
    return shaded(rendering, table, (), tints, outdoors=outdoors)


def test_empty_pixels_are_a_white_page_or_the_sky() -> None:
    page, sky = (floor_picture(outdoors=outdoors)[0, 0] for outdoors in (False, True))
    assert page.tolist() == [255, 255, 255]
    assert sky[2] > sky[0]


def test_floor_shows_its_pattern() -> None:
    floor = floor_picture(outdoors=False)[-6:].reshape(-1, 3)
    assert len(np.unique(floor, axis=0)) > 10
    assert (floor.mean(axis=0)[:-1] > floor.mean(axis=0)[1:]).all(), "wood is red before green before blue"


def test_pane_shows_the_sky_and_no_texture() -> None:
    assert (floor_picture(outdoors=False, pane=True)[-3:] != floor_picture(outdoors=False)[-3:]).any()


def test_equal_scenes_have_equal_materials() -> None:
    scene = build_base_scene("gates_bedroom", seed=0)
    looks = [[part_materials(asset) for asset in scene.assets.values()] for _ in range(2)]
    assert looks[0] == looks[1]
