"""Footprint classes: a class pose suits every object in the class, and an analysis covers the scene's objects."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.footprints import (
    HEIGHTS_M,
    LEVEL_FLOOR,
    SIDES_M,
    box_of,
    footprint_of,
    pose_box_asset,
)
from embomatrix.sim.placing.placement import Placer
from embomatrix.sim.placing.pose_cache import PlacementLibrary, analyse_scene
from embomatrix.sim.state.relations import Relations
from embomatrix.world.geometry import IDENTITY, Pose
from embomatrix.world.poses import PlacementKey, StandPose
from embomatrix.world.state import Relation

SIZE = st.tuples(st.floats(0.01, 0.5), st.floats(0.01, 0.5), st.floats(0.01, 0.45))


class CountingEngine(BulletEngine):
    settles = 0

    def settle(self, *args, **kwargs):
        self.settles += 1
        return super().settle(*args, **kwargs)


@pytest.fixture(scope="module")
def pool():
    pool = ClientPool()
    yield pool
    pool.close()


@pytest.fixture(scope="module")
def engine(pool):
    engine = CountingEngine(kitchen_scene(), pool)
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def cache(engine):
    library = PlacementLibrary()
    yield analyse_scene(engine, library, seed=3)
    library.close()


@given(SIZE)
def test_object_lies_within_its_class_at_every_yaw(size) -> None:
    thing = make.block("block", "block.n.01", size, {})
    standing = Pose.from_xyz_yaw(0.3, -0.2, size[2] / 2, 0.0)
    footprint = footprint_of(thing, standing)
    box = bounds_of(box_of(footprint)).box(IDENTITY)
    inner = bounds_of(thing).box(pose_box_asset(footprint, thing, standing))
    assert all(a <= b + 1e-9 for a, b in zip(box.low_m, inner.low_m, strict=True))
    assert all(a >= b - 1e-9 for a, b in zip(box.high_m, inner.high_m, strict=True))
    assert inner.low_m[2] == pytest.approx(box.low_m[2])
    assert footprint.long_m in SIDES_M
    assert footprint.height_m in HEIGHTS_M


def test_too_large_object_has_no_class() -> None:
    thing = make.block("block", "block.n.01", (0.9, 0.2, 0.2), {})
    assert footprint_of(thing, IDENTITY) is None


def test_sets_of_flat_supports_hold_eight_poses_or_more(cache) -> None:
    sizes = {
        key: len(poses)
        for key, poses in cache.placements.items()
        if key.relation is Relation.ONTOP and key.support_asset_id.startswith(("countertop", "breakfast"))
    }
    assert sizes
    assert min(sizes.values()) >= 8


def test_every_small_object_has_a_standing_pose(engine, cache) -> None:
    for item in engine.scene.objects:
        if not item.fixed:
            assert PlacementKey(item.asset_id, LEVEL_FLOOR, Relation.ONTOP) in cache.placements


def class_poses(engine, cache, held, target, relation) -> list[Pose]:
    asset, support = engine.scene.asset_of(held), engine.scene.asset_of(target)
    (standing,) = cache.placements[PlacementKey(asset.asset_id, LEVEL_FLOOR, Relation.ONTOP)]
    footprint = footprint_of(asset, standing)
    key = PlacementKey(footprint.name, support.asset_id, relation)
    pose_box_held = pose_box_asset(footprint, asset, standing)
    return [pose @ pose_box_held for pose in cache.placements.get(key, ())]


def test_every_object_is_stable_at_the_poses_of_its_class(engine, cache) -> None:
    looked_at = 0
    for held in ("mug_1", "apple_1", "chicken_leg_1", "bowl_1", "table_lamp_1"):
        for target in ("countertop_1", "breakfast_table_1", "shelf_1", "fridge_1"):
            for relation in (Relation.ONTOP, Relation.INSIDE):
                engine.reset()
                for pose in class_poses(engine, cache, held, target, relation)[:6]:
                    engine.set_pose(held, engine.pose(target) @ pose)
                    if engine.penetrates(held):
                        continue
                    settled = engine.settle(held)
                    assert settled.stable, (held, target, relation)
                    assert settled.moved_m < 0.005, (held, target, relation)
                    looked_at += 1
    assert looked_at > 60


def test_class_pose_is_used_without_settling(engine, cache) -> None:
    engine.reset()
    placer = Placer(engine, Relations(engine), cache)
    engine.park("mug_1")
    before = engine.settles
    pose = placer.find("mug_1", "breakfast_table_1", Relation.ONTOP, StandPose(2.0, 0.3, 1.57))
    assert isinstance(pose, Pose)
    assert engine.settles == before
    engine.set_pose("mug_1", pose)
    assert engine.settle("mug_1").stable
