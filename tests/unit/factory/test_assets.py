"""Geometry of assets: size, cavities, surfaces and swing of doors."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from embomatrix.factory.assets.cabinets import MAX_PARTS
from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import HUNG, build_asset, family_of, family_of_model
from embomatrix.factory.assets.shapes import mesh_of
from embomatrix.world.asset import JointKind
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.geometry import Aabb, Pose, Shape

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.world.asset import Asset, Joint, Link
    from embomatrix.world.geometry import ConvexPart, FloatArray, Vec3

SCENES = ("Rs_int", "Wainscott_0_int", "restaurant_diner", "house_single_floor")
SMALL = (
    "apple apricot avocado bagel banana beer_bottle bell_pepper blender bottle_of_wine bowl "
    "box_of_cereal bucket can_of_soda carrot carton casserole chicken chopping_board coffee_cup "
    "colander cooler croissant cucumber cupcake dish_rack donut egg electric_kettle frying_pan goblet "
    "hamburger hardback hinged_jar kettle laptop lemon lettuce mixing_bowl mug mushroom notebook "
    "orange packing_box pan pillow pineapple pitcher pizza plate potato pumpkin rag rice_cooker "
    "saucepan saucepot sponge steak stockpot tablefork table_knife tablespoon teacup teapot toaster "
    "toaster_oven tomato toolbox towel tray tupperware vase violin_case water_bottle water_glass "
    "watermelon wineglass wok "
)
HERE = Pose((0.0, 0.0, 0.0))
CATALOG = Catalog.load()


def chosen_models() -> Iterator[tuple[str, str]]:
    """Return all models of four scenes, and two models of each small and each openable category."""
    found = {
        (category, model)
        for scene_id in SCENES
        for room in CATALOG.inventory(scene_id).rooms
        for category, model, _ in (*room.items, *room.doors, *room.windows)
    }
    openable = [name for name in CATALOG.category_names if "openable" in CATALOG.category(name).abilities]
    for name in (*SMALL.split(), *openable):
        if name in CATALOG.category_names:
            found |= {(name, model.model_id) for model in CATALOG.models_of(name)[:2]}
    yield from sorted(found)


ASSETS = [build_asset(CATALOG, category, model) for category, model in chosen_models()]
WITH_JOINTS = [asset for asset in ASSETS if asset.joints]


def planes_of(part: ConvexPart) -> tuple[FloatArray, FloatArray]:
    """Return half spaces of a part: normals (n, 3) and offsets, in the asset's frame."""
    mesh = mesh_of(part)
    return mesh.face_normals, np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0])


def corners_of(part: ConvexPart) -> FloatArray:
    if part.vertices_m:
        return part.pose.apply_all(np.asarray(part.vertices_m))
    return np.asarray(mesh_of(part).vertices)


def box_corners(box: Aabb) -> FloatArray:
    return np.array(
        [
            (x, y, z)
            for x in (box.low_m[0], box.high_m[0])
            for y in (box.low_m[1], box.high_m[1])
            for z in (box.low_m[2], box.high_m[2])
        ]
    )


def overlap_m(part: ConvexPart, corners: FloatArray, axes: FloatArray) -> float:
    """Return the least depth over the tried separating axes, an upper bound of the penetration; negative when apart."""
    normals, _ = planes_of(part)
    tried = np.vstack((normals, axes))
    own, other = corners_of(part) @ tried.T, corners @ tried.T
    depth = np.minimum(own.max(axis=0) - other.min(axis=0), other.max(axis=0) - own.min(axis=0))
    return float(depth.min())


def moved(points: FloatArray, joint: Joint, fraction: float) -> FloatArray:
    """Transform points of a link from joint position zero to a share of its travel."""
    if joint.kind is JointKind.PRISMATIC:
        return points + np.asarray(joint.axis) * joint.upper * fraction
    half = joint.upper * fraction / 2
    x, y, z = (component * math.sin(half) for component in joint.axis)
    turn = Pose((0.0, 0.0, 0.0), (x, y, z, math.cos(half)))
    return turn.apply_all(points - np.asarray(joint.origin_m)) + np.asarray(joint.origin_m)


def parts_at(link: Link, fraction: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Return corners and face axes of a door's or drawer's boxes at a share of its travel."""
    assert link.joint is not None
    axes = moved(np.eye(3), link.joint, fraction) - moved(np.zeros((1, 3)), link.joint, fraction)
    for part in link.parts:
        yield moved(corners_of(part), link.joint, fraction), axes


def corners_at(link: Link, fraction: float) -> FloatArray:
    return np.vstack([corners for corners, _ in parts_at(link, fraction)])


def parts_of(asset: Asset, link: str) -> tuple[ConvexPart, ...]:
    """Return the parts of a link; an empty name is the base."""
    return next(item.parts for item in asset.links if item.name == (link or "base"))


def interior_box(center_m: Vec3, size_m: Vec3) -> Aabb:
    low = tuple(c - s / 2 for c, s in zip(center_m, size_m, strict=True))
    high = tuple(c + s / 2 for c, s in zip(center_m, size_m, strict=True))
    return Aabb((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def test_every_family_has_a_generator_and_a_category() -> None:
    assert all(callable(family.build) for family in Family)
    used = {
        family_of_model(CATALOG, name, model.model_id)
        for name in CATALOG.category_names
        for model in CATALOG.models_of(name)
    }
    assert used == set(Family)


def test_box_of_an_asset_is_the_size_of_its_model() -> None:
    for asset in ASSETS:
        box = Aabb.around(part.aabb(HERE) for link in asset.links for part in link.parts)
        assert box.size_m == pytest.approx(asset.size_m, abs=1e-5), asset.asset_id
        assert box.center_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-5), asset.asset_id


def test_links_stay_within_the_engines_limits() -> None:
    for asset in ASSETS:
        names = [link.name for link in asset.links]
        assert len(names) == len(set(names))
        assert asset.links[0].joint is None
        for link in asset.links:
            assert 1 <= len(link.parts) <= MAX_PARTS, (asset.asset_id, link.name)
            for part in link.parts:
                assert np.isfinite([*part.size_m, *part.pose.position_m]).all()
                assert min(part.size_m) > 1e-3, (asset.asset_id, link.name)
                assert (part.shape is Shape.HULL) == bool(part.vertices_m)


def test_parts_are_closed_convex_solids() -> None:
    for asset in ASSETS[::5]:
        for part in (part for link in asset.links for part in link.parts):
            mesh = mesh_of(part)
            assert mesh.is_watertight, asset.asset_id
            assert 0.0 < mesh.volume <= np.prod(part.size_m) * (1 + 1e-6), asset.asset_id
            if part.vertices_m:
                assert len(part.vertices_m) <= 64, asset.asset_id


def test_openable_categories_have_joints() -> None:
    for asset in ASSETS:
        assert asset.can("openable") == bool(asset.joints), asset.asset_id


def test_names_of_supports_and_interiors_are_unique_and_refer_to_each_other() -> None:
    for asset in ASSETS:
        supports, interiors = [s.name for s in asset.supports], {i.name for i in asset.interiors}
        assert len(supports) == len(set(supports)), asset.asset_id
        assert len(interiors) == len(asset.interiors), asset.asset_id
        assert {s.interior for s in asset.supports if s.interior} == interiors, asset.asset_id
        doors = {name for name, _ in asset.joints}
        assert all(set(interior.closed_by) <= doors for interior in asset.interiors), asset.asset_id


def test_supports_lie_on_top_of_parts() -> None:
    for asset in ASSETS:
        for support in asset.supports:
            boxes = [part.aabb(HERE) for part in parts_of(asset, support.link)]
            x, y, z = support.center_m
            under = [
                b for b in boxes if b.contains((x, y, b.center_m[2]), 1e-6) and abs(b.high_m[2] - z) < 1e-4
            ]
            assert under, (asset.asset_id, support)
            assert min(support.size_m) > 0.0
            assert support.clearance_m > 0.0


def test_nothing_stands_in_the_space_above_a_support() -> None:
    for asset in ASSETS:
        for support in asset.supports:
            (x, y, z), (dx, dy) = support.center_m, support.size_m
            free = Aabb(
                (x - dx / 2, y - dy / 2, z), (x + dx / 2, y + dy / 2, z + min(support.clearance_m, 5.0))
            )
            assert_free(asset, free, 2e-4, parts_of(asset, support.link))


def test_interiors_are_empty() -> None:
    for asset in ASSETS:
        for interior in asset.interiors:
            space = interior_box(interior.center_m, interior.size_m)
            assert_free(asset, space, 2e-4, parts_of(asset, interior.link))


def assert_free(asset: Asset, free: Aabb, tolerance_m: float, riding: tuple[ConvexPart, ...] = ()) -> None:
    corners = box_corners(free)
    for part in (*asset.links[0].parts, *riding):
        if part.aabb(HERE).overlaps(free, -tolerance_m):
            assert overlap_m(part, corners, np.eye(3)) <= tolerance_m, (asset.asset_id, free, part)


def test_cavities_hold_a_probe_of_three_centimetres_where_their_size_allows() -> None:
    roomy = [asset for asset in ASSETS if asset.can("fillable") and min(asset.size_m) > 0.06]
    for asset in roomy:
        if family_of(CATALOG, asset.category) in (
            Family.BOTTLE,
            Family.CAN,
            Family.SLAB,
            Family.SOFT,
            Family.PLATE,
            Family.SHELVING,
            Family.TRAY,
        ):
            continue  # sealed packages and plates: their contents are substances; objects stand on shelves and trays
        assert asset.interiors, asset.asset_id
        assert max(min(interior.size_m) for interior in asset.interiors) >= 0.03, asset.asset_id


def test_closed_doors_touch_neither_the_frame_nor_the_contents() -> None:
    for asset in WITH_JOINTS:
        assert_clear(asset, (0.0,))


def test_doors_swing_without_touching_the_frame() -> None:
    # A third of them: the sanity test looks at all, in another way.
    for asset in WITH_JOINTS[::3]:
        assert_clear(asset, (0.1, 0.3, 0.5, 0.7, 0.9, 1.0))


def assert_clear(asset: Asset, fractions: tuple[float, ...]) -> None:
    for link in asset.links[1:]:
        for fraction in fractions:
            for corners, axes in parts_at(link, fraction):
                for part in asset.links[0].parts:
                    depth = overlap_m(part, corners, axes)
                    assert depth <= 1e-5, (asset.asset_id, link.name, fraction, depth)


def test_open_door_leaves_the_opening_of_its_cavity_free() -> None:
    for asset in WITH_JOINTS:
        for interior in asset.interiors:
            mouth = interior_box(interior.center_m, interior.size_m)
            # what goes in comes from the front, or from above past a lid
            ways = [
                Aabb(mouth.low_m, (mouth.high_m[0] + 0.3, *mouth.high_m[1:])),
                Aabb(mouth.low_m, (*mouth.high_m[:2], mouth.high_m[2] + 0.3)),
            ]
            doors = [link for link in asset.links if link.name in interior.closed_by and not interior.link]
            assert bool(doors) == (not interior.link and bool(interior.closed_by)), (asset.asset_id, interior)
            assert any(is_free_of(doors, way) for way in ways), (asset.asset_id, interior.name)


def is_free_of(doors: list[Link], way: Aabb) -> bool:
    for door in doors:
        corners = corners_at(door, 1.0)
        low, high = corners.min(axis=0), corners.max(axis=0)
        if all(
            lo < w_hi - 1e-6 and w_lo + 1e-6 < hi
            for lo, hi, w_lo, w_hi in zip(low, high, way.low_m, way.high_m, strict=True)
        ):
            return False
    return True


def test_open_doors_stay_within_the_width_of_their_cabinet() -> None:
    for asset in WITH_JOINTS:
        half = asset.size_m[1] / 2
        for link in asset.links[1:]:
            for fraction in (0.25, 0.5, 0.75, 1.0):
                corners = corners_at(link, fraction)
                assert np.abs(corners[:, 1]).max() <= half + 1e-5, (asset.asset_id, link.name)


def test_loose_objects_have_a_flat_base_under_their_centre() -> None:
    for asset in ASSETS:
        if asset.mass_kg > 5.0 or family_of(CATALOG, asset.category) in HUNG:
            continue
        floor = -asset.size_m[2] / 2
        feet = np.vstack([corners_of(part) for part in asset.links[0].parts])
        feet = feet[feet[:, 2] < floor + 1e-4]
        assert len(feet) >= 3, asset.asset_id
        assert (feet.min(axis=0)[:2] < 0.0).all(), asset.asset_id
        assert (feet.max(axis=0)[:2] > 0.0).all(), asset.asset_id


def test_tables_and_beds_are_free_below() -> None:
    for category in ("breakfast_table", "coffee_table", "desk", "commercial_kitchen_table", "bed", "sofa"):
        asset = build_asset(CATALOG, category, CATALOG.models_of(category)[0].model_id)
        below = [
            part.aabb(HERE).low_m[2]
            for part in asset.links[0].parts
            if part.aabb(HERE).contains((0.0, 0.0, 0.0), 9.0)
        ]
        middle = [
            part.aabb(HERE)
            for part in asset.links[0].parts
            if part.aabb(HERE).contains((0.0, 0.0, part.aabb(HERE).center_m[2]))
        ]
        assert below
        assert min(box.low_m[2] for box in middle) > -asset.size_m[2] / 2 + 0.05, category


def test_doors_of_the_same_bay_close_the_same_cavity() -> None:
    fridge = build_asset(CATALOG, "fridge", "xyejdx")
    assert [name for name, _ in fridge.joints] == ["door"]
    assert all(interior.closed_by == ("door",) for interior in fridge.interiors)
    assert len(fridge.interiors) >= 3
    wide = build_asset(CATALOG, "fridge", "dxwbae")
    assert {name for name, _ in wide.joints} == {
        "bay1_right_door", "bay1_left_door", "bay2_right_door", "bay2_left_door",
    }  # fmt: skip


def test_drawer_slides_out_by_four_fifths_with_its_floor_and_cavity() -> None:
    drawers = [(asset, link) for asset in WITH_JOINTS for link in asset.links[1:] if "drawer" in link.name]
    assert len({asset.category for asset, _ in drawers}) >= 5
    for asset, link in drawers:
        (interior,) = [item for item in asset.interiors if item.link == link.name]
        (floor,) = [item for item in asset.supports if item.link == link.name]
        assert interior.closed_by == (link.name,)
        assert floor.interior == interior.name
        assert link.joint is not None
        assert link.joint.axis == (1.0, 0.0, 0.0)
        depth = np.ptp(corners_at(link, 0.0)[:, 0])
        assert link.joint.upper == pytest.approx(min(0.8 * depth, 0.6), abs=1e-4)
        # four walls hold the floor's edges: a panel and three boards, a finger high
        walls = [part for part in link.parts if part.size_m[2] > 0.02 and min(part.size_m[:2]) < 0.03]
        assert len(walls) == 4, asset.asset_id


def test_models_listed_with_a_joint_have_drawers() -> None:
    for category in ("desk", "nightstand", "coffee_table", "console_table"):
        for model in CATALOG.models_of(category):
            asset = build_asset(CATALOG, category, model.model_id)
            assert asset.can("openable") == bool(asset.joints)
            assert not asset.joints or "joint" in model.meta_links
    kinds = {
        tuple(
            sorted(
                {
                    name.rstrip("0123456789")
                    for name, _ in build_asset(CATALOG, "bottom_cabinet", m.model_id).joints
                }
            )
        )
        for m in CATALOG.models_of("bottom_cabinet")
    }
    assert {("door",), ("drawer",), ("door", "drawer")} <= kinds


def test_ovens_drop_their_door_and_chests_lift_their_lid() -> None:
    oven = build_asset(CATALOG, "oven", "wuinhm")
    ((name, joint),) = oven.joints
    assert (name, joint.axis) == ("door", (0.0, 1.0, 0.0))
    assert joint.origin_m[0] == pytest.approx(oven.size_m[0] / 2)
    chest = build_asset(CATALOG, "cedar_chest", CATALOG.models_of("cedar_chest")[0].model_id)
    corners = corners_at(chest.links[1], 1.0)
    assert corners[:, 2].min() > chest.size_m[2] / 2 - 0.05


def test_building_twice_gives_equal_assets() -> None:
    for category, model in (("fridge", "xyejdx"), ("bowl", CATALOG.models_of("bowl")[0].model_id)):
        first = build_asset(CATALOG, category, model)
        assert build_asset.__wrapped__(CATALOG, category, model) == first


def test_coordinates_are_rounded_to_a_micrometre() -> None:
    for asset in ASSETS[::7]:
        for part in (part for link in asset.links for part in link.parts):
            values = [*part.size_m, *part.pose.position_m, *(v for point in part.vertices_m for v in point)]
            assert all(value == round(value, 6) for value in values), asset.asset_id


def test_building_takes_less_than_five_milliseconds() -> None:
    build = build_asset.__wrapped__
    started = time.process_time()
    for asset in ASSETS:
        build(CATALOG, *asset.asset_id.rsplit("-", 1))
    assert (time.process_time() - started) / len(ASSETS) < 0.005


def test_stall_has_a_counter_at_working_height_below_a_roof() -> None:
    stand = build_asset(CATALOG, "farm_stand", CATALOG.models_of("farm_stand")[0].model_id)
    (counter,) = stand.supports
    assert counter.center_m[2] + stand.size_m[2] / 2 == pytest.approx(0.9)
    assert counter.clearance_m > 1


def test_unknown_model_is_named() -> None:
    with pytest.raises(CatalogError, match="unknown model of fridge 'nope'"):
        build_asset(CATALOG, "fridge", "nope")
