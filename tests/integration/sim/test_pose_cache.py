"""The pose cache: verified placements by content, and standing poses."""

import dataclasses
import time

import pytest
from tests.fakes import furniture as make
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.mini_world import MiniWorld, StaticObject
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import beside, candidates, stands_in
from embomatrix.sim.placing.pose_cache import POSES, Contents, PlacementLibrary
from embomatrix.sim.state.relations import Relations
from embomatrix.world.asset import Asset, Credit, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape
from embomatrix.world.poses import PlacementKey
from embomatrix.world.state import Relation

MOVABLE = ("apple_1", "chicken_leg_1", "mug_1")
SUPPORTS = ("breakfast_table_1", "fridge_1", "microwave_1", "stove_1", "bowl_1", "shelf_1")


@pytest.fixture(scope="module")
def pool():
    pool = ClientPool()
    yield pool
    pool.close()


@pytest.fixture(scope="module")
def cache():
    return build_pose_cache(kitchen_scene(), MOVABLE, SUPPORTS, seed=1)


def test_every_sensible_pair_has_at_least_eight_poses(cache) -> None:
    expected = {
        ("apple", "breakfast_table", Relation.ONTOP),
        ("apple", "breakfast_table", Relation.UNDER),
        ("chicken_leg", "microwave", Relation.INSIDE),
        ("chicken_leg", "bowl", Relation.INSIDE),
        ("mug", "fridge", Relation.INSIDE),
        ("mug", "shelf", Relation.ONTOP),
        ("apple", "stove", Relation.ONTOP),
    }
    for held, support, relation in expected:
        key = PlacementKey(f"{held}-{make.MODEL}", f"{support}-{make.MODEL}", relation)
        assert 8 <= len(cache.placements[key]) <= POSES, key


def test_impossible_pairs_have_no_entry(cache) -> None:
    keys = {(key.support_asset_id, key.relation) for key in cache.placements}
    assert (f"stove-{make.MODEL}", Relation.INSIDE) not in keys
    assert (f"stove-{make.MODEL}", Relation.UNDER) not in keys
    assert (f"shelf-{make.MODEL}", Relation.UNDER) not in keys


def test_every_cached_pose_has_its_relation_and_is_stable(cache, pool) -> None:
    assets = kitchen_scene().assets
    mini = MiniWorld(pool)
    for key, poses in cache.placements.items():
        held, support = assets[key.asset_id], assets[key.support_asset_id]
        base = Pose((0.0, 0.0, support.size_m[2] / 2))
        mini.stage(held, base @ poses[0], (), [StaticObject(support, base, (0.0,) * len(support.joints))])
        for pose in poses[::5]:
            assert stands_in(held, pose, support, key.relation)
            assert mini.drop(base @ pose, steps=240).moved_m < 0.01, key
    mini.close()


def test_poses_are_spread_over_the_surface(cache) -> None:
    poses = cache.placements[
        PlacementKey(f"apple-{make.MODEL}", f"breakfast_table-{make.MODEL}", Relation.ONTOP)
    ]
    quadrants = {(pose.position_m[0] > 0, pose.position_m[1] > 0) for pose in poses}
    assert len(quadrants) == 4
    heights = {
        round(pose.position_m[2], 1)
        for pose in cache.placements[PlacementKey(f"mug-{make.MODEL}", f"shelf-{make.MODEL}", Relation.ONTOP)]
    }
    assert len(heights) == 4  # one for each board


def test_every_named_object_has_standing_poses(cache) -> None:
    assert set(cache.stands) == {*MOVABLE, *SUPPORTS}
    assert all(cache.stands.values())


def test_equal_seeds_give_equal_caches(cache, pool) -> None:
    library = PlacementLibrary()
    engine = BulletEngine(kitchen_scene(), pool)
    build_pose_cache(kitchen_scene(), ("table_lamp_1",), ("sink_1",), seed=1, engine=engine, library=library)
    again = build_pose_cache(kitchen_scene(), MOVABLE, SUPPORTS, seed=1, engine=engine, library=library)
    assert again == cache
    other = build_pose_cache(
        kitchen_scene(), MOVABLE[:1], SUPPORTS[:1], seed=2, engine=engine, library=library
    )
    key = PlacementKey(f"apple-{make.MODEL}", f"breakfast_table-{make.MODEL}", Relation.ONTOP)
    assert other.placements[key] != cache.placements[key]
    engine.close()
    library.close()


def test_library_identifies_assets_by_content() -> None:
    library = PlacementLibrary()
    first = library.poses(make.apple(), make.kitchen_table(), Relation.ONTOP, 0)
    started = time.process_time()
    assert library.poses(make.apple(), make.kitchen_table(), Relation.ONTOP, 0) is first
    assert time.process_time() - started < 0.1
    low = dataclasses.replace(make.kitchen_table(), mass_kg=21.0)
    assert library.poses(make.apple(), low, Relation.ONTOP, 0) != first
    library.close()


def test_content_digest_of_an_asset_is_pinned() -> None:
    """Seeds of cached poses come from content digests: another digest changes every generated scene."""
    hull = ConvexPart(Shape.HULL, Pose((0.1, 0.0, 0.0)), (0.1, 0.2, 0.3), ((0.0, 0.0, 0.0), (0.1, 0.2, 0.3)))
    fridge = Asset(
        "fridge-pin",
        "fridge",
        "electric_refrigerator.n.01",
        (0.6, 0.6, 1.8),
        80.0,
        (
            Link("base", (make.box((0.0, 0.0, 0.0), (0.6, 0.6, 1.8)),)),
            Link("door", (hull,), Joint(JointKind.REVOLUTE, (0.3, 0.2, 0.0), (0.0, 0.0, 1.0), 1.5)),
        ),
        (SupportSurface("top", (0.0, 0.0, 0.9), (0.6, 0.6), 0.5),),
        (Interior("inside", (0.0, 0.0, 0.0), (0.5, 0.5, 1.5)),),
        {"openable": {}, "coldSource": {"temperature": -100.0}},
        Credit("author", "CC0", "source"),
    )
    assert Contents().of(fridge) == "4971fbcd00afcdf24c6d80f2bb8664f701dd52c9fe8c5cfb84d4e03109b31ca8"


def test_too_tall_object_is_not_placed_inside_a_cavity() -> None:
    lamp, microwave = make.table_lamp(), make.microwave()
    assert list(candidates(lamp, microwave, Relation.INSIDE, (0.5, 0.5), 20)) == []
    assert len(list(candidates(make.apple(), microwave, Relation.INSIDE, (0.5, 0.5), 20))) == 20


def test_relations_that_place_cannot_make_have_no_candidates() -> None:
    assert list(candidates(make.apple(), make.kitchen_table(), Relation.NEXTTO, (0.5, 0.5), 20)) == []


def test_unknown_name_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        build_pose_cache(kitchen_scene(), ("unicorn_1",), SUPPORTS, seed=0)


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_poses_beside_a_neighbour_satisfy_nextto(pool, yaw: float) -> None:
    scene = kitchen_scene()
    engine = BulletEngine(scene, pool)
    library = PlacementLibrary()
    table, lamp = scene.by_name["breakfast_table_1"].pose_world_asset, make.table_lamp()
    x, y, z = table.position_m
    top_m = z + scene.asset_of("breakfast_table_1").size_m[2] / 2
    neighbour = Pose.from_xyz_yaw(x, y, top_m + lamp.size_m[2] / 2, yaw)
    engine.set_pose("table_lamp_1", neighbour)
    box = bounds_of(lamp).box(table.inverse() @ neighbour)
    poses = library.poses_beside(
        scene.asset_of("mug_1"), scene.asset_of("breakfast_table_1"), Relation.ONTOP, box
    )
    relations = Relations(engine)
    for pose in poses:
        engine.set_pose("mug_1", table @ pose)
        assert relations.nextto("mug_1", "table_lamp_1"), pose
        assert relations.ontop("mug_1", "breakfast_table_1"), pose
    sides = {(round(pose.position_m[0], 2) > 0, round(pose.position_m[1], 2) > 0) for pose in poses}
    assert len(sides) >= 3
    engine.close()
    library.close()


def test_poses_beside_a_neighbour_stay_on_the_surface() -> None:
    apple, table = make.apple(), make.kitchen_table()
    width, depth, height = table.size_m
    corner = Aabb((width / 2 - 0.3, depth / 2 - 0.3, height / 2), (width / 2, depth / 2, height / 2 + 0.3))
    for pose in beside(apple, table, Relation.ONTOP, corner):
        x, y, _ = pose.position_m
        assert abs(x) + apple.size_m[0] / 2 <= width / 2
        assert abs(y) + apple.size_m[1] / 2 <= depth / 2
    assert list(beside(apple, table, Relation.ONTOP, corner))
